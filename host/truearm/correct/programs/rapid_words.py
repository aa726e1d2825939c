"""RAPID's instructions and functions by effect (ABB, technical reference manual 3HAC050917, and process package
manuals).

Compared with the words of a public syntax file (rapid-for-vim 2.3.0): each of its movements is listed here among the
moves or the instructions without a target, or is not listed and therefore rejected. Exceptions are those that only
stop, start or retrace a path (Break, StartMove, StopMove, PathRecMoveBwd …).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

from truearm.correct.programs.tokens import words


class Move(NamedTuple):
    """An instruction that moves the robot: the places of its targets and of its tool among the arguments."""

    targets: tuple[int, ...] = (0,)
    tool: int = 3


_TWO = (0, 1)
MOVES: Mapping[str, Move] = {
    **dict.fromkeys(
        words("movel movej moveldo movejdo movelao movejao movelgo movejgo movelsync movejsync moveabsj"), Move()
    ),
    **dict.fromkeys(words("movec movecdo movecao movecgo movecsync"), Move(_TWO, 4)),
    **dict.fromkeys(words("triggl triggj triggabsj"), Move((0,), 4)),
    **dict.fromkeys(words("trigglios triggjios"), Move((0,), -1)),
    "triggc": Move(_TWO, 5),
    "searchl": Move((2,), 4),
    "searchj": Move((2,), 4),
    "searchc": Move((2, 3), 5),
    # The tool is the last argument, whatever process data precede it: ArcWare before RobotWare 5 has weavedata among
    # them.
    **dict.fromkeys(
        words("arcl arclstart arclend arcl1 arcl1start arcl1end arcl2 arcl2start arcl2end"), Move((0,), -1)
    ),
    **dict.fromkeys(
        words("arcc arccstart arccend arcc1 arcc1start arcc1end arcc2 arcc2start arcc2end"), Move(_TWO, -1)
    ),
    **dict.fromkeys(
        words("spotl spotj spotml spotmj paintl displ dispj capl nutl nutj arcmovel arcmovej"), Move((0,), -1)
    ),
    **dict.fromkeys(words("paintc dispc capc"), Move(_TWO, -1)),
    **dict.fromkeys(words("paintldo paintlsig"), Move((0,), -1)),
}
_LINEAR = ("movel", "triggl", "searchl", "arcl", "arcmovel", "spotl", "spotml", "paintl", "displ", "capl", "nutl")
STRAIGHT = frozenset(name for name in MOVES if name.startswith(_LINEAR))
AIMLESS = words(
    """
    calibj calibl contactl cssdeactmovel egmmovec egmmovel egmrunjoint egmrunpose fcact fcpress1lstart fcpressc fcpressend
    fcpressl fcrefstart indamove indcmove inddmove indrmove mtoolrotcalib mtooltcpcalib searchextj stoolrotcalib
    stooltcpcalib
    """
)
QUIET = words(
    """
    accset acteventbuffer actunit add aliascamera aliasio aliasioreset arcrefresh bitclear bitset bookerrno break
    camflush camgetparameter camgetresult camloadjob camreqimage camsetexposure camsetparameter camsetprogrammode
    camsetrunmode camstartloadjob camwaitloadjob cancelload capaptrsetup capaptrsetupai capaptrsetupao
    capaptrsetuppers capcondsetdo capequidist capnoprocess caprefresh capsetstopmode capweavesync checkprogref
    cirpathmode clear cleariobuff clearpath clearrawbytes clkreset clkstart clkstop close closedir comment
    consolewrite copyfile copyrawbytes cornerpathwarning corrclear corrcon corrdiscon corrwrite cssact
    cssdeact deacteventbuffer deactunit decr ditheract ditherdeact dropsensor dropwobj egmactjoint egmactmove
    egmactpose egmgetid egmreset egmsetupai egmsetupao egmsetupgi egmsetupltapp egmsetupuc egmstop egmstreamstart
    egmstreamstop erasemodule errlog errraise errwrite exitcycle fccalib fcdeact fcloadid fitcircle getdataval
    getgroupsignalinfo getjointdata getsysdata gettorquemargin gettrapdata gripload hollowwristreset icap idelete
    idisable ienable ierror incr indreset initsuperv invertdo iobusstart iobusstate iodisable ioenable ipathpos
    ipers ipssetparam irmqmessage isignalai isignalao isignaldi isignaldo isignalgi isignalgo isleep itimer
    ivarvalue iwatch load loadid makedir manloadidproc matrixsolve matrixsolveqr matrixsvd mechunitload
    motionprocessmodeset motionsup open opendir packdnheader packrawbytes pathacclim pathlengthreset
    pathlengthstart pathlengthstop pathrecmovebwd pathrecmovefwd pathrecstart pathrecstop pathresol pntproduserlog
    procerrrecovery pulsedo raisetouser readanybin readblock readcfgdata readerrdata readrawbytes readvararr
    recoverymenu recoverymenuwr recoveryposreset recoveryposset removeallcyclicbool removecyclicbool removedir
    removefile removesuperv renamefile reset resetaxisdistance resetaxismovetime resetppmoved resetretrycount
    resettorquemargin restopath rewind rmqemptyqueue rmqfindslot rmqgetmessage rmqgetmsgdata rmqgetmsgheader
    rmqreadwait rmqsendmessage rmqsendwait safetycontrollersyncrequest save savecfgdata scwrite sendevice set setao
    setbrush setbrushfac setdatasearch setdo setgo setleadthrough setsysdata settmsignal setupcyclicbool setupsuperv
    setwrprocname siclose siconnect sigetcyclic sisetcyclic skipwarn socketaccept socketbind socketclose
    socketconnect socketcreate socketlisten socketreceive socketreceivefrom socketsend socketsendto softact
    softdeact speedlimaxis speedlimcheckpoint speedrefresh spystart spystop startload startmove startmoveretry
    stcalib stclose stepbwdpath stindgun stindgunreset stop stopen stopmove stopmovereset storepath sttune
    sttunereset supsyncsensoroff supsyncsensoron swgetcalibdata swgetfixtipdata swsetintforcedata swsetintgundata
    swsetintsimdata swsetintspotdata syncmoveoff syncmoveon syncmoveresume syncmovesuspend syncmoveundo synctosensor
    systemstopaction testsigndefine testsignreset texttabinstall tperase tpreaddnum tpreadfk tpreadnum tpshow
    tpwrite triggcheckio triggdatacopy triggdatareset triggequip triggint triggio triggrampao triggspeed
    triggstopproc tryint tunereset tuneservo uimsgbox uimsgwrite uimsgwriteabort uishow unload unpackrawbytes velset
    waitai waitao waitdi waitdo waitgi waitgo waitload waitrob waitsensor waitsynctask waittestandset waittime
    waituntil waitwobj warmstart worldacclim write writeanybin writebin writeblock writecfgdata writerawbytes
    writestrbin writevar writevararr wzboxdef wzcyldef wzdisable wzdoset wzenable wzfree wzhomejointdef
    wzlimjointdef wzlimsup wzsphdef
    """
)
FUNCTIONS = words(
    """
    abs absdnum acos acosdnum ainput aoutput argname asin asindnum atan atan2 atan2dnum atandnum bitand bitanddnum
    bitcheck bitcheckdnum bitlsh bitlshdnum bitneg bitnegdnum bitor bitordnum bitrsh bitrshdnum bitxor bitxordnum
    bytetostr calcjointt calcrobt calcrotaxframez calcrotaxisframe camgetexposure camgetloadedjob camgetname
    camnumberofresults capgetfailsigs cdate cjointt clkread corrread cos cosdnum cpos crobt crossprod cspeedoverride
    ctime ctool cwobj dectohex defaccframe defdframe defframe dim dinput distance dnumtonum dnumtostr dotprod
    doutput egmgetstate eulerzyx eventtype exechandler execlevel exp filesize filetime filetimednum fssize
    getaxisdistance getaxismovetime getmaxnumberofcyclicbool getmecunitname getmodalpayloadmode getmotortorque
    getnextcyclicbool getnextmechunit getnextsym getnumberofcyclicbool getserviceinfo getsignal getsignaldnum
    getsignalorigin getsysinfo gettaskname gettime gettspstatus getuasusername ginput ginputdnum goutput goutputdnum
    hextodec indinpos indspeed iounitstate isbrakecheckactive iscyclicbool isfile isleadthrough ismechunitactive
    ispers isstopmoveact isstopstateevent issyncmoveon issysid isvar max maxextlinearspeed maxextreorientspeed
    maxrobspeed min mirpos modexist modtime motionplannerno nonmotionmode norient numtodnum numtostr opmode orobt
    paridposvalid paridrobvalid pathlengthget pathlevel pathrecvalidbwd pathrecvalidfwd pfrestart poseinv posemult
    posevect pow powdnum ppmovedinmanmode present progmemfree rawbyteslen readbin readdir readmotor readnum readstr
    readstrbin readvar remainingretries rmqgetslotname robname robos round rounddnum runmode sin sindnum
    socketgetstatus socketpeek sqrt sqrtdnum stcalcforce stcalctorque stiscalib stisclosed stisindgun stisopen
    strdigcalc strdigcmp strfind strformat strlen strmap strmatch strmemb strorder strpart strtobyte strtoval tan
    tandnum taskisactive taskisexecuting taskrunmec taskrunrob tasksinsync testandset testdi testsignread textget
    texttabfreetouse texttabget trunc truncdnum type uialphaentry uiclientexist uidnumentry uidnumtune uilistview
    uimessagebox uinumentry uinumtune validio valtostr vectmagn
    """
)
BY_NAME = words("callbyvar setalldataval setdataval")
SEARCHES = words("searchc searchj searchl")
READING = words(
    """
    accset clkreset clkstart clkstop errlog errwrite gripload idisable ienable invertdo isignaldi itimer iwatch motionsup pulsedo reset save set setao setdo
    setgo socketsend softact stop tpwrite triggequip triggio triggint uimsgwrite uishow velset waitai waitdi waitdo waitgi waittime waituntil worldacclim
    write writebin writestrbin
    """
)
WRITING_FUNCTIONS = words(
    "dnumtostr getnextmechunit getnextsym readdir strtobyte strtoval testandset uimessagebox uilistview"
)
_FOLLOWED = words(
    "pdispon pdispset pdispoff eoffson eoffsset eoffsoff confj confl singarea moveextj offs orientzyx reltool"
)
# These read their arguments; everything else, including what the program does not define, may assign to them.
READERS = (frozenset(MOVES) | FUNCTIONS | READING | _FOLLOWED) - WRITING_FUNCTIONS
