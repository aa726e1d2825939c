"""RAPID's instructions and functions by effect (ABB, technical reference manual 3HAC050917, and process package
manuals).

All movements are among the moves or the instructions without a target, compared with the words of a public syntax file
(rapid-for-vim 2.3.0). Of the others only those are listed that programs use: any other word counts as a routine that
none of the files defines. That costs a move, never correctness.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

from truearm.correct.programs.tokens import words


class Move(NamedTuple):
    """An instruction that moves the robot: the places of its targets and of its tool among the arguments."""

    targets: tuple[int, ...]
    tool: int


_POINTS = words(
    """
    arcl arcl1 arcl1end arcl1start arcl2 arcl2end arcl2start arclend arclstart arcmovej arcmovel capl dispj displ moveabsj movej
    movel nutj nutl paintl paintldo paintlsig spotj spotl spotmj spotml triggabsj triggj triggjios triggl trigglios
    """
)
_CIRCLES = words(
    """
    arcc arcc1 arcc1end arcc1start arcc2 arcc2end arcc2start arccend arccstart capc dispc movec paintc triggc
    """
)
MOVES: Mapping[str, Move] = {
    # The tool is the last argument, whatever process data precede it: ArcWare before RobotWare 5 has weavedata among
    # them.
    **dict.fromkeys(_POINTS, Move((0,), -1)),
    **dict.fromkeys(_CIRCLES, Move((0, 1), -1)),
    **dict.fromkeys(words("moveldo movejdo movelao movejao movelgo movejgo movelsync movejsync"), Move((0,), 3)),
    **dict.fromkeys(words("movecdo movecao movecgo movecsync"), Move((0, 1), 4)),
    **dict.fromkeys(("searchl", "searchj"), Move((2,), -1)),
    "searchc": Move((2, 3), -1),
}
_LINEAR = ("movel", "triggl", "searchl", "arcl", "arcmovel", "spotl", "spotml", "paintl", "displ", "capl", "nutl")
STRAIGHT = frozenset(name for name in MOVES if name.startswith(_LINEAR))
AIMLESS = words(
    """
    calibj calibl contactl cssdeactmovel egmmovec egmmovel egmrunjoint egmrunpose fcact fcpress1lstart fcpressc
    fcpressend fcpressl fcrefstart indamove indcmove inddmove indrmove mtoolrotcalib mtooltcpcalib searchextj
    stoolrotcalib stooltcpcalib
    """
)
DISPLACING = words("eoffson eoffsset pdispon pdispset")
BY_NAME = words("callbyvar setalldataval setdataval")
LOADING = words("callbyvar load startload waitload")
SEARCHES = words("searchc searchj searchl")
# These read their arguments; everything else, including what the program does not define, may assign to them.
READING = words(
    """
    abs accset acos ainput aoutput asin atan atan2 bitand bitcheck bitcheckdnum bitlsh bitor bitrsh bytetostr
    calcjointt calcrobt cdate cjointt clkread clkreset clkstart clkstop confj confl cos cpos crobt crossprod
    cspeedoverride ctime ctool cwobj defaccframe defdframe defframe dim dinput distance dnumtonum dotprod doutput
    eoffsoff errlog errwrite eulerzyx exp getmotortorque getsysinfo gettaskname gettime ginput ginputdnum goutput
    gripload idisable ienable indinpos invertdo isfile isignaldi ismechunitactive isstopmoveact itimer iwatch max
    maxrobspeed min mirpos motionsup moveextj numtodnum numtostr offs opmode orientzyx orobt pdispoff poseinv
    posemult posevect pow present pulsedo readbin readnum readstr reltool reset robname robos round runmode set
    setao setdo setgo sin singarea socketgetstatus socketpeek socketsend softact sqrt stop strfind strformat strlen
    strmatch strpart tan testdi tpwrite triggequip triggint triggio trunc type uiclientexist uimsgwrite uinumentry
    uishow validio valtostr vectmagn velset waitai waitdi waitdo waitgi waittime waituntil worldacclim write
    writebin writestrbin
    """
)
ASSIGNING = words(
    """
    actunit add aliasio bitclear bitset break cirpathmode clear clearpath clearrawbytes close connect
    cornerpathwarning corrcon corrdiscon corrwrite deactunit decr dropwobj egmactjoint egmgetid egmreset egmsetupuc
    errraise exit exitcycle fccalib fcdeact fcloadid getdataval getjointdata getnextsym getsysdata goto idelete incr
    indreset ipers isignalai isignalao isignaldo isignalgi isignalgo isleep loadid makedir mechunitload open opendir
    packrawbytes pathrecmovebwd pathrecmovefwd pathrecstart pathrecstop pathresol raise readcfgdata readrawbytes
    removefile renamefile resetretrycount restopath retry return rewind setdatasearch setsysdata socketaccept
    socketbind socketclose socketconnect socketcreate socketlisten socketreceive softdeact speedrefresh startmove
    startmoveretry stclose stopen stopmove stopmovereset storepath strtobyte strtoval supsyncsensoroff
    supsyncsensoron syncmoveoff syncmoveon syncmoveundo testandset tperase tpreadfk tpreadnum tpshow triggcheckio
    triggrampao triggspeed triggstopproc trynext tunereset tuneservo uilistview uimessagebox uimsgbox unload
    unpackrawbytes waitao waitgo waitrob waitsensor waitsynctask waittestandset waitwobj writecfgdata writerawbytes
    wzboxdef wzcyldef wzdisable wzdoset wzenable wzfree wzhomejointdef wzlimjointdef wzlimsup wzsphdef
    """
)
READERS = (frozenset(MOVES) | READING | DISPLACING) - SEARCHES
LANGUAGE = frozenset(MOVES) | READING | ASSIGNING | AIMLESS | DISPLACING | BY_NAME | LOADING
