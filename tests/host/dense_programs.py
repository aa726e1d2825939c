"""Large programs in the style of the vendors' editors, as a reader has to accept them: plain targets, and much logic.

RobotStudio writes each target as a constant and each path as a procedure; PolyScope each waypoint as two globals and the program as
one loop with step markers. Cells' programs have few targets and much logic.
"""

from itertools import count

FREE = "[9E+09,9E+09,9E+09,9E+09,9E+09,9E+09]"
TOOL = "[TRUE,[[0,0,120.5],[0.965925826,0,0.258819045,0]],[3.2,[0,0,60],[1,0,0,0],0,0,0]]"
WORK = '[FALSE,TRUE,"",[[612.4,-180.2,95],[1,0,0,0]],[[0,0,0],[1,0,0,0]]]'


def numbers(k):
    """Return x, y, z [mm] of the k-th target, all different."""
    return 300 + k * 7919 % 4000 / 10, -200 + k * 6151 % 4000 / 10, 150 + k * 3571 % 3000 / 10


def robtarget(k):
    x, y, z = numbers(k)
    return f"[[{x:.3f},{y:.3f},{z:.3f}],[0.006147562,0.706989511,0.707173162,0.004211],[{k % 2 - 1},0,{k % 3 - 1},0],{FREE}]"


def robotstudio(targets=3000, path=50):
    """Targets, then paths, then main, which calls them; comments and zones as RobotStudio has them."""
    lines = [
        "MODULE Module1",
        f"\tPERS tooldata tWeld:={TOOL};",
        f"\tTASK PERS wobjdata Workobject_1:={WORK};",
        *(f"\tCONST robtarget Target_{10 * k}:={robtarget(k)};" for k in range(targets)),
        "!***********************************************************",
        "!",
        "! Module:  Module1",
        "!",
        "!***********************************************************",
        "\tPROC main()",
        *(f"\t\tPath_{10 * k};" for k in range(targets // path)),
        "\tENDPROC",
    ]
    for first in range(0, targets, path):
        lines.append(f"\tPROC Path_{first // path * 10}()")
        lines.append(f"\t    MoveJ Target_{10 * first},v1000,z100,tWeld\\WObj:=Workobject_1;")
        lines += [f"\t    MoveL Target_{10 * k},v{100 + k % 9}0,z{k % 10},tWeld\\WObj:=Workobject_1;" for k in range(first + 1, first + path)]  # fmt: skip
        lines.append("\tENDPROC")
    return "\r\n".join([*lines, "ENDMODULE", ""])


def plain_rapid(size):
    """Short names, targets in place and by name, nothing else: as dense as a generator writes."""
    lines, length = ["MODULE m", "PROC main()"], 0
    for k in count():
        x, y, z = numbers(k)
        lines.append(f"MoveL [[{x:.1f},{y:.1f},{z:.1f}],[0,1,0,0],[0,0,0,0],{FREE.replace('+09', '9')}],v100,z1,tool0;")
        length += len(lines[-1])
        if length > size:
            return "\n".join([*lines, "ENDPROC", "ENDMODULE"])


def cell(size):
    """A handling cell: routines with inputs, outputs, counters, choices, loops, error handlers, and calls with arguments."""
    lines = [
        "MODULE Cell",
        f"  PERS tooldata tGrip:={TOOL};",
        f"  PERS wobjdata wBelt:={WORK};",
        "  VAR num nParts:=0;",
        "  VAR num nState:=0;",
        "  VAR bool bReady:=FALSE;",
        '  VAR string sText:="";',
        f"  CONST robtarget pHome:={robtarget(1)};",
    ]
    body, calls, length = [], [], 0
    for k in count():
        part = [
            f"  CONST robtarget pPick{k}:={robtarget(5 * k + 2)};",
            f"  CONST robtarget pPlace{k}:={robtarget(5 * k + 3)};",
        ]
        routine = f"""  PROC rPart{k}(num nSpeed\\switch Check)
    ! part {k}: pick, check and place
    IF nState<>{k % 7} THEN
      TPWrite "state "\\Num:=nState;
      nState:={k % 7};
    ENDIF
    MoveJ Offs(pPick{k},0,0,80),v1000,z50,tGrip\\WObj:=wBelt;
    WaitDI diPart{k % 16},1\\MaxTime:=5;
    MoveL Offs(pPick{k},0,0,{k % 5 + 1}),v200,fine,tGrip\\WObj:=wBelt;
    SetDO doGrip{k % 4},1;
    WaitTime 0.2;
    TEST GInput(giType)
    CASE {k % 9},{k % 9 + 1}:
      nParts:=nParts+1;
      bReady:=TRUE;
    CASE {k % 9 + 2}:
      FOR i FROM 1 TO 3 DO
        PulseDO\\PLength:=0.1,doLamp;
        WaitTime 0.1*i;
      ENDFOR
    DEFAULT:
      bReady:=FALSE;
      sText:="type "+NumToStr({k},0);
    ENDTEST
    WHILE bReady=FALSE AND nParts<{k % 50 + 10} DO
      WaitUntil diReady=1\\MaxTime:=nSpeed/10;
      nParts:=nParts+1;
    ENDWHILE
    IF Present(Check) AND nParts>0 THEN
      rCheck nParts,\\Twice;
    ELSEIF nParts=0 THEN
      Stop;
    ENDIF
    MoveJ pPlace{k},v1000,z10,tGrip\\WObj:=wBelt;
    SetDO doGrip{k % 4},0;
  ERROR
    IF ERRNO=ERR_WAIT_MAXTIME THEN
      TPWrite "no part {k}";
      RETRY;
    ENDIF
    RAISE;
  ENDPROC"""
        lines += part
        body.append(routine)
        calls.append(f"      CASE {k}:\n        rPart{k} {k % 30 + 1}\\Check;")
        length += len(routine) + len(calls[-1]) + sum(map(len, part))
        if length > size:
            break
    main = """  PROC main()
    MoveJ pHome,v500,fine,tGrip;
    WHILE TRUE DO
      TEST GInput(giPart)
%s
      DEFAULT:
        WaitTime 0.5;
      ENDTEST
    ENDWHILE
  ENDPROC
  PROC rCheck(num nCount\\switch Twice)
    IF nCount>100 THEN
      nParts:=0;
    ENDIF
    IF Present(Twice) rLamp;
  ENDPROC
  PROC rLamp()
    SetDO doLamp,1;
    WaitTime 0.1;
    SetDO doLamp,0;
  ENDPROC"""
    return "\n".join([*lines, main % "\n".join(calls), *body, "ENDMODULE", ""])


def polyscope(size):
    """Waypoints as globals, then the tree's steps in the main loop, with folders' choices, waits and outputs."""
    points, steps, length = [], [], 0
    for k in count(1):
        x, y, z = (value / 1000 for value in numbers(k))
        points.append(
            f"  global Waypoint_{k}_p=p[{x:.15f}, {y:.15f}, {z:.15f}, 2.221437469163187, -2.221437469163187, {k % 7}E-5]"
        )
        points.append(
            f"  global Waypoint_{k}_q=[{', '.join(f'{v:.15f}' for v in (x, -1.57 + y, 1.2 - z, -1.1, -1.57, 0.1))}]"
        )
        step = 6 * k
        steps.append(f'    $ {step} "MoveJ"\n    $ {step + 1} "Waypoint_{k}" "breakAfter"')
        if k % 3:
            steps.append(f"    movel(Waypoint_{k}_p, a=1.2, v=0.25, r=0.0{k % 5})")
        else:
            steps.append(
                f"    movej(get_inverse_kin(Waypoint_{k}_p, qnear=Waypoint_{k}_q), a=1.3962634015954636, v=1.0471975511965976)"
            )
        steps.append(
            f'    $ {step + 2} "If digital_in[{k % 8}]≟ True "\n    if (get_standard_digital_in({k % 8}) == True ):'
        )
        steps.append(
            f'      $ {step + 3} "Set" "noBreak"\n      set_standard_digital_out({k % 8}, True)\n      Counter_{k % 10} = Counter_{k % 10} + 1\n    end'
        )
        steps.append(f'    $ {step + 4} "Wait: 0.5"\n    sleep(0.5)')
        length = sum(map(len, points)) + sum(map(len, steps)) if k % 50 == 0 else length
        if length > size:
            break
    counters = [f"  global Counter_{k}=0" for k in range(10)]
    lines = ["def Program_1():", "  set_tcp(p[0.0,0.0,0.12,0.0,0.0,0.0])", "  set_payload(1.2, [0.0, 0.0, 0.05])", *counters, *points, "  while (True):", '    $ 1 "Robot Program"', *steps, "  end", "end", ""]  # fmt: skip
    return "\n".join(lines)
