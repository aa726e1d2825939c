"""What RAPID's instructions and functions mean for the moves of a program (ABB, technical reference manual 3HAC050917).

A robtarget lies in the object frame of its work object: user frame · object frame · target; the tool's frame is that of its tooldata. ``Offs`` shifts a
target along the work object's axes, ``RelTool`` along the tool's. An instruction that is not listed may move the robot, and is said.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from scipy.spatial.transform import Rotation

from truearm.files.programs.dataflow import UNDECLARED, Flow
from truearm.files.programs.environment import Key
from truearm.files.programs.rapid import PASSED, Module
from truearm.files.programs.syntax import Call, Expression, Form, Number, Source, Taught, Text, Truth, words
from truearm.files.programs.tree_walks import calls_in
from truearm.files.programs.values import (
    NOWHERE,
    Listed,
    Pose,
    Unknown,
    Value,
    Values,
    combined,
    first_unknown,
    fixed_mm,
    joined,
    numbers_of,
    shifted,
    taught_pose,
    times,
    turned,
)
from truearm.units import MM

DISPLACED = "program displacement"
CONFIGURATIONS = ("confj", "confl")  # whether they are watched in joint moves, and in the others


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
    # arc welding: target, speed, seam, weld, zone, tool
    **dict.fromkeys(words("arcl arclstart arclend arcl1 arcl1start arcl1end arcl2 arcl2start arcl2end"), Move((0,), 5)),
    **dict.fromkeys(words("arcc arccstart arccend arcc1 arcc1start arcc1end arcc2 arcc2start arcc2end"), Move(_TWO, 6)),
    # the tool is the last argument whatever process data stand before it
    **dict.fromkeys(
        words("spotl spotj spotml spotmj paintl displ dispj capl nutl nutj arcmovel arcmovej"), Move((0,), -1)
    ),
    **dict.fromkeys(words("paintc dispc capc"), Move(_TWO, -1)),
    **dict.fromkeys(words("paintldo paintlsig"), Move((0,), -1)),
}
_LINEAR = ("movel", "triggl", "searchl", "arcl", "arcmovel", "spotl", "spotml", "paintl", "displ", "capl", "nutl")
STRAIGHT = frozenset(name for name in MOVES if name.startswith(_LINEAR))
BY_JOINTS = frozenset(name for name in MOVES if "j" in name.removeprefix("moveabsj"))
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
    motionprocessmodeset motionsup moveextj open opendir packdnheader packrawbytes pathacclim pathlengthreset
    pathlengthstart pathlengthstop pathrecmovebwd pathrecmovefwd pathrecstart pathrecstop pathresol pntproduserlog
    procerrrecovery pulsedo raisetouser readanybin readblock readcfgdata readerrdata readrawbytes readvararr
    recoverymenu recoverymenuwr recoveryposreset recoveryposset removeallcyclicbool removecyclicbool removedir
    removefile removesuperv renamefile reset resetaxisdistance resetaxismovetime resetppmoved resetretrycount
    resettorquemargin restopath rewind rmqemptyqueue rmqfindslot rmqgetmessage rmqgetmsgdata rmqgetmsgheader
    rmqreadwait rmqsendmessage rmqsendwait safetycontrollersyncrequest save savecfgdata scwrite sendevice set setao
    setbrush setbrushfac setdatasearch setdo setgo setleadthrough setsysdata settmsignal setupcyclicbool setupsuperv
    setwrprocname siclose siconnect sigetcyclic singarea sisetcyclic skipwarn socketaccept socketbind socketclose
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
    setgo singarea socketsend softact stop tpwrite triggequip triggio triggint uimsgwrite uishow velset waitai waitdi waitdo waitgi waittime waituntil worldacclim
    write writebin writestrbin
    """
)
WRITING_FUNCTIONS = words(
    "dnumtostr getnextmechunit getnextsym readdir strtobyte strtoval testandset uimessagebox uilistview"
)
_FIELDS: Mapping[str, int] = {
    **{"trans": 0, "rot": 1, "robconf": 2, "extax": 3, "robax": 0, "x": 0, "y": 1, "z": 2, "robhold": 0, "tframe": 1, "tload": 2},
    **{"ufprog": 1, "ufmec": 2, "uframe": 3, "oframe": 4, "q1": 0, "q2": 1, "q3": 2, "q4": 3, "cf1": 0, "cf4": 1, "cf6": 2, "cfx": 3},
    **{f"rax_{k}": k - 1 for k in range(1, 7)},
    **{f"eax_{letter}": k for k, letter in enumerate("abcdef")},
}  # fmt: skip
NO_AXES = tuple(f"[{','.join([none] * 6)}]]" for none in ("9E9", "9E+09"))  # as most editors write them
NO_AXIS = 8.9e9  # 9E9 stands for an external axis that there is not
_TOOL, _OBJECT = "tool0", "wobj0"


@dataclass(frozen=True)
class Rapid:
    """RAPID's meaning. ``fields``: places of components in records; ``harmless``: routines from elsewhere that do not move the robot."""

    fields: Mapping[str, int]
    harmless: frozenset[str] = frozenset()

    @property
    def outer_names(self) -> bool:
        """A name that a routine does not declare is the module's."""
        return True

    def changed_by(self, call: Call) -> Sequence[Expression]:
        """The arguments that an instruction may assign to: all but of those that are known to read them."""
        if call.function in SEARCHES:
            return call.arguments[1:2]
        writes = call.function in WRITING_FUNCTIONS or (call.function in QUIET and call.function not in READING)
        return (*call.arguments, *(argument for _, argument in call.named)) if writes else ()

    def literal(self, of: Taught) -> Value:
        """A literal robtarget or jointtarget, as it is."""
        return of

    def call(self, flow: Flow, call: Call, arguments: Sequence[Values], named: Mapping[str, Values]) -> Values | None:
        """What an instruction or function of the language gives, after its effect; None where it is none."""
        name, at = call.function, call.start
        if name in MOVES:
            self._move(flow, call, arguments, named)
            return ()
        if name in BY_NAME:
            flow.uncertain(
                name, at, call.end, f"{name} changes data, or calls a routine, by a name that only the run knows"
            )
            return ()
        if name in AIMLESS:
            flow.uncertain(name, at, call.end, f"{name} moves the robot without a target that is in the program")
            return ()
        if name in ("pdispon", "pdispset", "eoffson", "eoffsset"):
            flow.set(DISPLACED, (Unknown(f"{name} displaces the program at run time", at),), "global")
            return ()
        if name in ("pdispoff", "eoffsoff"):
            flow.set(DISPLACED, (NOWHERE,), "global")
            return ()
        if name in CONFIGURATIONS:
            flow.set(name, (Truth("off" not in named),), "global")
            return ()
        if name == PASSED:
            return arguments[0]
        if name == "offs" and len(arguments) == 4:
            return combined(at, lambda *given: _offs(given, at), arguments)
        if name == "orientzyx" and len(arguments) == 3:
            return combined(at, lambda *given: _orient(given, at), arguments)
        if name == "reltool" and len(arguments) == 4:
            turns = [named.get(key, (Number(0.0),)) for key in ("rx", "ry", "rz")]
            return combined(at, lambda *given: _reltool(given, at), [*arguments, *turns])
        if name in QUIET or name in FUNCTIONS or name in self.harmless:
            return (Unknown(f"what {name} gives is known at run time only", at),)
        return None

    def item(self, of: Value, at: Value | str, place: int) -> Values:
        """An element of an array, counted from 0, or a component of a record; nothing where the array ends before it."""
        if isinstance(of, Unknown):
            return (of,)
        items = _items(of)
        k = self.fields.get(at) if isinstance(at, str) else int(at.value) if isinstance(at, Number) else None
        if items is None or (isinstance(at, str) and k is None):
            return (Unknown("an element or component is not followed", place),)
        if k is not None:
            return items[k] if 0 <= k < len(items) else ()
        return tuple(dict.fromkeys(value for item in items for value in item))

    def changed(self, of: Value, at: Value | str, new: Values, place: int) -> Value:
        """An array or record with another item."""
        items = _items(of)
        k = self.fields.get(at) if isinstance(at, str) else int(at.value) if isinstance(at, Number) else None
        if items is None or k is None or not 0 <= k < len(items):
            return of if isinstance(of, Unknown) else Unknown("an element is assigned that is not followed", place)
        return Listed((*items[:k], new, *items[k + 1 :]))

    def _move(self, flow: Flow, call: Call, arguments: Sequence[Values], named: Mapping[str, Values]) -> None:
        move, name, at = MOVES[call.function], call.function, call.start
        if len(arguments) <= max(*move.targets, move.tool, 0) or not arguments:
            flow.uncertain(name, at, call.end, "arguments are missing")
            return
        if "corr" in named:
            flow.uncertain(name, at, call.end, r"\Corr changes the path at run time")
        tools = tuple(_tool(value, at) for value in arguments[move.tool])
        absent = (Truth(False),)  # an optional parameter that is passed on and was not given
        given = named.get("wobj", absent)
        objects = tuple(NOWHERE if value in absent else _object(value, at) for value in given)
        displaced = flow.get(DISPLACED) or (NOWHERE,)
        objects = tuple(value for value in displaced if isinstance(value, Unknown)) + objects
        free = Truth(False) in (flow.get(CONFIGURATIONS[name not in BY_JOINTS]) or ())
        targets = [
            (tuple(self._beside(_target(value, at), at, free) for value in arguments[k]), call.arguments[k])
            for k in move.targets
        ]
        flow.goes_to(call, targets, tools, objects, straight=name in STRAIGHT)

    def _beside(self, target: Value, at: int, free: bool) -> Value:
        """A target, unless one of its external axes may move the robot's base; ``free``: in any configuration."""
        if isinstance(target, Pose) and free:
            target = target._replace(free=True)
        like = target.like if isinstance(target, Pose) else None
        if like is None or like.text.replace(" ", "").endswith(NO_AXES):
            return target
        used = (f"eax_{letter}" for letter, axis in zip("abcdef", like.values[11:], strict=False) if axis < NO_AXIS)
        first = next((axis for axis in used if axis not in self.harmless), None)
        return (
            target if first is None else Unknown(f"its external axis {first} may move the robot's base", at, "harmless")
        )


def analyse(source: Source, modules: Sequence[Module], frames: Mapping[str, Pose], harmless: frozenset[str]) -> Flow:
    """Follow a program; ``frames`` are tools and work objects that are declared elsewhere."""
    records = {
        name: k for module in modules for record in module.records.values() for k, (_, name) in enumerate(record)
    }
    clash = {
        name
        for module in modules
        for record in module.records.values()
        for k, (_, name) in enumerate(record)
        if records[name] != k or _FIELDS.get(name, k) != k
    }
    fields = {name: k for name, k in {**_FIELDS, **records}.items() if name not in clash}
    routines = [routine for module in modules for routine in module.routines]
    flow = Flow(source, Rapid(fields, frozenset(name.lower() for name in harmless)), routines)
    for name, pose in {_TOOL: NOWHERE, _OBJECT: NOWHERE, DISPLACED: NOWHERE, **frames}.items():
        flow.environment.set((0, name), (pose,))
    for name in CONFIGURATIONS:
        flow.environment.set((0, name), (Truth(True),))
    begin: dict[str, Values] = {}
    for module in modules:
        for datum in module.data:
            if datum.name in begin or datum.name in flow.routines:
                raise source.wrong(
                    datum.start, f"{datum.name} is declared twice in this file; put each module into a file of its own"
                )
            if datum.value is None:
                why = f"{datum.name} is declared without a value"
                begin[datum.name] = (Unknown(why, datum.start),)
            else:
                begin[datum.name] = flow.value(datum.value)
            flow.environment.set((0, datum.name), begin[datum.name])
    kept = _assigned_elsewhere(modules)
    used = {
        call.function for one in routines for call in calls_in((one.body, one.handlers)) if call.function != one.name
    }
    entries = sorted((one for one in routines if one.name not in used), key=lambda one: one.name != "main")
    entries += [one for one in routines if one.name == "main" and one not in entries]
    record: dict[Key, dict[Value, None]] = {}
    flow.environment.records.append(record)
    for turn in range(MAX_ROUNDS):
        grown = False
        for routine in entries:
            flow.environment.layers.append({})
            flow.enter(routine, None, (), {})
            flow.environment.layers.pop()
            for name in kept:
                # all that it ever was: the run may be stopped anywhere, or ended by ExitCycle
                before = flow.environment.get((0, name))
                after = joined(before, tuple(record.get((0, name), ())))
                grown |= after != before
                flow.environment.set((0, name), after)
        if not grown:
            break
        if turn == MAX_ROUNDS - 2:
            for name in kept:
                flow.environment.set((0, name), (Unknown(f"{name} changes from run to run", 0),))
    flow.environment.records.pop()
    for routine in routines:  # what may be run at any time: traps, service routines, and what only such routines call
        if routine.name != "main" and (routine in entries or routine.name not in flow.called):
            flow.environment.layers.append({key: tuple(seen) for key, seen in record.items()})
            flow.enter(routine, None, (), {})
            flow.environment.layers.pop()
    return flow


MAX_ROUNDS = 4


def _assigned_elsewhere(modules: Sequence[Module]) -> tuple[str, ...]:
    """Data that keep what one routine or run gave them for the next, in the order of the text; so do the displacement and what is watched."""
    return (
        *(datum.name for module in modules for datum in module.data if datum.kind != "const"),
        DISPLACED,
        *CONFIGURATIONS,
    )


def _target(value: Value, at: int) -> Value:
    if isinstance(value, Unknown | Pose):
        return value
    if isinstance(value, Taught):
        return taught_pose(value) if value.form is Form.ROBTARGET else value
    if not isinstance(value, Listed):
        return Unknown("its target is no robtarget and no jointtarget", at)
    pose = _frame((Listed(value.items[:2]),)) if len(value.items) == 4 else None
    axes = numbers_of(value.items[3][0]) if pose is not None and len(value.items[3]) == 1 else None
    if pose is not None and (axes is None or min(axes) < NO_AXIS):
        return _unknown_in(value) or Unknown("its external axes may move the robot's base", at)
    return _unknown_in(value) or pose or Unknown("its target is not of plain numbers in one piece", at)


def _tool(value: Value, at: int) -> Value:
    """The frame of a tooldata."""
    if isinstance(value, Pose):
        return value
    if isinstance(value, Unknown):
        return value._replace(remedy="tools") if value.remedy == UNDECLARED else value
    if not isinstance(value, Listed) or len(value.items) != 3:
        return Unknown("its tool is no tooldata", at)
    if value.items[0] != (Truth(True),):
        return Unknown("its tool is not held by the robot", at)
    pose = _frame(value.items[1])
    return pose or _unknown_in(value) or Unknown("its tool has no frame of plain numbers", at)


def _object(value: Value, at: int) -> Value:
    """The frame of a wobjdata: user frame and object frame."""
    if isinstance(value, Pose):
        return value
    if isinstance(value, Unknown):
        return value._replace(remedy="works") if value.remedy == UNDECLARED else value
    if not isinstance(value, Listed) or len(value.items) != 5:
        return Unknown("its work object is no wobjdata", at)
    in_hand, fixed_frame, unit, users, own = value.items
    if in_hand != (Truth(False),):
        return Unknown("its work object is held by the robot", at)
    if fixed_frame != (Truth(True),) or unit != (Text(""),):
        return Unknown("its work object is moved by a mechanical unit", at)
    frames = [_frame(users), _frame(own)]
    known = [frame for frame in frames if frame is not None]
    return (
        times(*known)
        if len(known) == 2
        else _unknown_in(value) or Unknown("its work object has no frames of plain numbers", at)
    )


def _frame(values: Values) -> Pose | None:
    """A pose [[x, y, z], [q1, q2, q3, q4]] of plain numbers."""
    if len(values) != 1 or not isinstance(values[0], Listed) or len(values[0].items) != 2:
        return None
    parts = [numbers_of(item[0]) if len(item) == 1 else None for item in values[0].items]
    place, turn = parts
    return fixed_mm(place, turn) if place and turn and (len(place), len(turn)) == (3, 4) else None


def _unknown_in(value: Value) -> Unknown | None:
    if isinstance(value, Unknown):
        return value
    if isinstance(value, Listed):
        return next((found for item in value.items for one in item if (found := _unknown_in(one)) is not None), None)
    return None


def _numbers(given: Sequence[Value]) -> list[float] | None:
    found = [one.value for one in given if isinstance(one, Number)]
    return found if len(found) == len(given) and all(map(math.isfinite, found)) else None


def _offs(given: Sequence[Value], at: int) -> Value:
    target, numbers = _target(given[0], at), _numbers(given[1:])
    if isinstance(target, Unknown):
        return target
    if numbers is None or not isinstance(target, Pose):
        return next(
            (one for one in given[1:] if isinstance(one, Unknown)), Unknown("the offsets of Offs are not known", at)
        )
    return times(shifted([float(MM.to_si(value)) for value in numbers]), target)


def _reltool(given: Sequence[Value], at: int) -> Value:
    """Rotations are about x first, then the new y, then the new z."""
    target, numbers = _target(given[0], at), _numbers(given[1:])
    if isinstance(target, Unknown):
        return target
    if numbers is None or not isinstance(target, Pose):
        return next(
            (one for one in given[1:] if isinstance(one, Unknown)),
            Unknown("the arguments of RelTool are not known", at),
        )
    turn = Rotation.from_euler("XYZ", numbers[3:], degrees=True)
    return times(target, shifted([float(MM.to_si(value)) for value in numbers[:3]]), turned(turn))


def _orient(given: Sequence[Value], at: int) -> Value:
    """A quaternion, scalar first, of turns about z, the new y, the new x [deg]."""
    numbers = _numbers(given)
    if numbers is None:
        return first_unknown(given) or Unknown("the angles of OrientZYX are not known", at)
    x, y, z, w = Rotation.from_euler("ZYX", numbers, degrees=True).as_quat().tolist()
    return Listed(tuple((Number(value),) for value in (w, x, y, z)))


def _items(of: Value) -> tuple[Values, ...] | None:
    """The items of a list or of a literal, as lists again."""
    if isinstance(of, Listed):
        return of.items
    if not isinstance(of, Taught):
        return None
    ends = (3, 7, 11, 17) if of.form is Form.ROBTARGET else (6, 12)
    values = of.values
    parts = [values[start:end] for start, end in zip((0, *ends), ends, strict=False)]
    return tuple((Listed(tuple((Number(value),) for value in part)),) for part in parts)
