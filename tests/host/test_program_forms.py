"""Programs as PolyScope, RobotStudio and post processors write them, and as people write them who measure at run time.

They were written from the vendors' forms alone, not from what truearm reads. Those that can be corrected are executed by the
interpreters: the true arm ends each move within 1 µm of the identified one, and only numbers change. In each of the others one
thing cannot be known: it is refused by the right lines, and in part all else is corrected.
"""

import contextlib
import re

import numpy as np
import pytest
from tests.host.controllers import Controller, Move
from tests.host.puma_bench import CHAIN, DESIGN, TRUTH
from tests.host.rapid_machine import run_rapid
from tests.host.test_program_corrections import (
    DATA,
    FEATURE,
    HERE,
    POSES,
    TOOLS,
    Q,
    in_feature,
    jointtarget,
    missed,
    mm,
    robtarget,
    six,
    tool_point,
    written,
)
from tests.host.urscript_machine import run_urscript

from truearm.correct.correction import MARGIN
from truearm.correct.joint_moves import JointMoves
from truearm.correct.model_pair import ModelPair
from truearm.workflows.correct_program import HowCorrected, ProgramOptions, ProgramRefused, correct_program

ENOUGH = 8  # moves: such programs run until they are stopped


class Stopped(Exception):
    """A person stops the program."""


class Stoppable(Controller):
    """A controller whose program is stopped after some moves."""

    def move_joints(self, q, seconds=0.0):
        self.stop()
        super().move_joints(q, seconds)

    def move_line(self, pose, speed):
        """Only its end counts here."""
        self.stop()
        self.q = self.solved(pose, self.q)
        self.moves.append(Move("line", self.t, self.t, self.q, pose, speed, np.zeros((0, 6))))

    def stop(self):
        if len(self.moves) >= ENOUGH:
            raise Stopped


def driven(text, suffix):
    machine = Stoppable(CHAIN, DESIGN, Q[0])
    text = text.removesuffix("\nProg1()\n")  # the controller runs it when its end arrives
    with contextlib.suppress(Stopped):
        (run_rapid if suffix == "mod" else run_urscript)(text, machine)
    return machine.moves


def corrected(folder, text, suffix, **options):
    path = folder / f"p.{suffix}"
    path.write_bytes(text.encode("latin-1"))
    how = HowCorrected(ModelPair(CHAIN, DESIGN, TRUTH), "newton", 1, Q[0], MARGIN)
    given = {"joint_moves": JointMoves.CORRECT, "tool": TOOLS[0] if suffix == "script" else None, **options}
    return correct_program(path, how, HERE, ProgramOptions(**given))


NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")

W = [six(p) for p in POSES]
V = [written(q) for q in Q]


def S(text):
    return text.strip("\n") + "\n"


HEADER = """
def Pick_and_place():
  global _hidden_verificationVariable=0
  step_count_5c1f0d32_9a = 0.0
  thread Step_Counter_Thread_75():
    while (True):
      step_count_5c1f0d32_9a = step_count_5c1f0d32_9a + 1.0
      sync()
    end
  end
  run Step_Counter_Thread_75()
  set_standard_analog_input_domain(0, 1)
  set_standard_analog_input_domain(1, 1)
  set_tool_analog_input_domain(0, 1)
  set_analog_outputdomain(0, 0)
  set_analog_outputdomain(1, 0)
  set_input_actions_to_default()
  set_tool_communication(False, 115200, 0, 1, 1.5, 3.5)
  set_tool_output_mode(0)
  set_tool_digital_output_mode(0, 1)
  set_tool_voltage(0)
  set_safety_mode_transition_hardness(1)
  set_tcp(p[0.0,0.005,0.02,0.03,0.0,0.05])
  set_target_payload(1.200000, [0.000000, 0.000000, 0.050000], [0.003, 0.003, 0.003, 0.0, 0.0, 0.0])
  set_gravity([0.0, 0.0, 9.82])
"""


def pts(*ks, tool=1):
    return "".join(f"  global Waypoint_{k}_p={six(tool_point(k, tool))}\n  global Waypoint_{k}_q={V[k]}\n" for k in ks)


def pol(body, ks=(1, 2, 3), tool=1):
    return S(HEADER) + pts(*ks, tool=tool) + body.strip("\n") + "\nend\n"


SCRIPTS = {}
SCRIPTS["polyscope 5, robot program"] = pol("""
  while (True):
    $ 1 "Robot Program"
    $ 2 "MoveJ"
    $ 3 "Waypoint_1" "breakAfter"
    movej(get_inverse_kin(Waypoint_1_p, qnear=Waypoint_1_q), a=1.3962634015954636, v=1.0471975511965976)
    $ 4 "MoveL"
    $ 5 "Waypoint_2" "breakAfter"
    movel(Waypoint_2_p, a=1.2, v=0.25)
    $ 6 "Wait: 0.5"
    sleep(0.5)
    $ 7 "Set DO[0]=On"
    set_standard_digital_out(0, True)
  end
""")
SCRIPTS["polyscope 5, feature and subprogram"] = pol(f"""
  global Plane_1=p{written(FEATURE)}
  global Waypoint_7_p={six(in_feature(tool_point(7, 1)))}
  def SubProgram_1():
    $ 12 "SubProgram_1" "noBreak"
    $ 13 "MoveL"
    movel(pose_trans(Plane_1, Waypoint_7_p), a=1.2, v=0.25)
  end
  $ 2 "MoveJ"
  movej(get_inverse_kin(Waypoint_1_p, qnear=Waypoint_1_q), a=1.4, v=1.05, r=0.025)
  $ 3 "Call SubProgram_1"
  SubProgram_1()
""")
SCRIPTS["polyscope 5, feature moved"] = pol(f"""
  global Plane_1=p{written(FEATURE)}
  $ 3 "MoveL"
  movej(get_inverse_kin(Waypoint_1_p, qnear=Waypoint_1_q), a=1.4, v=1.05)
  movel(pose_trans(Plane_1, pose_trans(pose_inv(p{written(FEATURE)}), Waypoint_2_p)), a=1.2, v=0.25)
""")
SCRIPTS["polyscope 5, movep and circle"] = pol(
    """
  movej(get_inverse_kin(Waypoint_1_p, qnear=Waypoint_1_q), a=1.4, v=1.05)
  movep(Waypoint_2_p, a=1.2, v=0.25, r=0.025)
  movec(Waypoint_3_p, Waypoint_4_p, a=1.2, v=0.25, r=0.025, mode=0)
""",
    (1, 2, 3, 4),
)
SCRIPTS["polyscope 5, if elseif else"] = pol("""
  if (get_standard_digital_in(0) == True ):
    movej(get_inverse_kin(Waypoint_1_p, qnear=Waypoint_1_q), a=1.4, v=1.05)
  elif (get_standard_digital_in(1) == True  and  not  get_standard_digital_in(2) == True ):
    movej(get_inverse_kin(Waypoint_2_p, qnear=Waypoint_2_q), a=1.4, v=1.05)
  else:
    movej(get_inverse_kin(Waypoint_3_p, qnear=Waypoint_3_q), a=1.4, v=1.05)
  end
""")
SCRIPTS["polyscope 5, loop with a counter"] = pol("""
  global Loop_1=0
  Loop_1 = 0
  while (Loop_1 < 3):
    movej(get_inverse_kin(Waypoint_1_p, qnear=Waypoint_1_q), a=1.4, v=1.05)
    movej(get_inverse_kin(Waypoint_2_p, qnear=Waypoint_2_q), a=1.4, v=1.05)
    Loop_1 = Loop_1 + 1
  end
""")
SCRIPTS["polyscope 5, wait for an input"] = pol("""
  movej(get_inverse_kin(Waypoint_1_p, qnear=Waypoint_1_q), a=1.4, v=1.05)
  while (get_standard_digital_in(1) == True):
    sync()
  end
  movel(Waypoint_2_p, a=1.2, v=0.25, t=2.0)
""")
SCRIPTS["polyscope 5, before start and a thread of signals"] = pol("""
  thread Thread_1():
    while (True):
      $ 20 "Thread_1"
      if (get_standard_digital_in(3) == True):
        set_standard_digital_out(2, True)
      end
      sync()
    end
  end
  threadId_Thread_1 = run Thread_1()
  movej(get_inverse_kin(Waypoint_1_p, qnear=Waypoint_1_q), a=1.4, v=1.05)
  kill threadId_Thread_1
  movel(Waypoint_2_p)
""")
SCRIPTS["polyscope 5, tools by variables"] = pol(f"""
  global TCP_1=p{written(TOOLS[1])}
  global TCP_2=p{written(TOOLS[2])}
  global Waypoint_9_p={six(tool_point(9, 2))}
  set_tcp(TCP_1)
  movej(get_inverse_kin(Waypoint_1_p, qnear=Waypoint_1_q), a=1.4, v=1.05)
  set_tcp(TCP_2, "TCP_2")
  movej(get_inverse_kin(Waypoint_9_p, qnear={V[9]}), a=1.4, v=1.05)
  movel(Waypoint_9_p)
""")
SCRIPTS["polyscope 5, switch"] = pol("""
  global choice=2
  if (choice == 1):
    movej(get_inverse_kin(Waypoint_1_p, qnear=Waypoint_1_q), a=1.4, v=1.05)
  elif (choice == 2):
    movej(get_inverse_kin(Waypoint_2_p, qnear=Waypoint_2_q), a=1.4, v=1.05)
  end
  movej(get_inverse_kin(Waypoint_3_p, qnear=Waypoint_3_q), a=1.4, v=1.05)
""")
SCRIPTS["polyscope 3 without markers"] = S(f"""
def prog():
  set_tcp(p[0.0,0.0,0.0,0.0,0.0,0.0])
  set_payload(0.0)
  set_gravity([0.0, 0.0, 9.82])
  Waypoint_1={W[1]}
  Waypoint_2={W[2]}
  while True:
    movej(Waypoint_1, a=1.3962634015954636, v=1.0471975511965976)
    movel(Waypoint_2, a=1.2, v=0.25)
  end
end
""")
SCRIPTS["joints taught"] = S(f"""
def prog():
	movej({V[1]}, a=1.3962634015954636, v=1.0471975511965976)
	movej({V[2]}, a=1.3962634015954636, v=1.0471975511965976, t=0, r=0.02)
	movel({W[3]}, 1.2, 0.25, 0, 0)
end
""")
SCRIPTS["positional arguments"] = S(f"""
def prog():
  movej({W[1]},1.4,1.05,0,0)
  movel({W[2]},1.2,0.25,0,0.01)
  movep({W[3]},1.2,0.25,0.01)
  movec({W[4]},{W[5]},1.2,0.25,0.0,0)
end
""")
SCRIPTS["RoboDK's post processor"] = S(f"""
def Prog1():
  # Global parameters:
  global speed_ms    = 0.250000
  global speed_rads  = 0.750000
  global accel_mss   = 1.200000
  global accel_radss = 1.200000
  global blend_radius_m = 0.001000
  global ref_frame = p[0,0,0,0,0,0]

  #--------------------------
  # Add any default subprograms here
  #--------------------------
  # Main program:
  ref_frame = p{written(FEATURE)}
  set_tcp(p{written(TOOLS[2])})
  movej({V[1]},accel_radss,speed_rads,0,0)
  movel(pose_trans(ref_frame,{six(in_feature(tool_point(2, 2)))}),accel_mss,speed_ms,0,blend_radius_m)
  movel(pose_trans(ref_frame,{six(in_feature(tool_point(3, 2)))}),accel_mss,speed_ms,0,blend_radius_m)
  # End of main program
end

Prog1()
""")
SCRIPTS["arguments by name in any order"] = S(f"""
def prog():
  movej(v=1.0, a=1.2, q={W[1]})
  movel(t=0, v=0.2, a=1.2, pose={W[2]}, r=0)
  movec(pose_to={W[4]}, pose_via={W[3]}, mode=1)
end
""")
SCRIPTS["servoj by inverse kinematics"] = S(f"""
def prog():
  q1 = get_inverse_kin({W[1]}, {V[1]}, 1e-10, 1e-10)
  movej(q1)
  servoj(get_inverse_kin({W[2]}, qnear={V[2]}), 0, 0, 0.008, 0.1, 300)
  servoj(get_inverse_kin({W[3]}, {V[3]}), t=0.008, lookahead_time=0.1, gain=300)
  stopj(2.0)
end
""")
SCRIPTS["list and its length"] = S(f"""
def prog():
  path = [{W[1]}, {W[2]}, {W[3]}]
  i = 0
  while i < get_list_length(path):
    movej(path[i], a=1.2, v=0.5)
    i = i + 1
  end
end
""")
SCRIPTS["list length in a name"] = S(f"""
def prog():
  path = [{W[1]}, {W[2]}, {W[3]}]
  n = length(path)
  i = n - 1
  while i >= 0:
    movej(path[i], a=1.2, v=0.5)
    i = i - 1
  end
end
""")
SCRIPTS["struct with its speed"] = S(f"""
def prog():
  pick = struct(pose={W[1]}, near={V[1]}, v=0.5)
  place = struct(pose={W[2]}, near={V[2]}, v=0.3)
  movej(get_inverse_kin(pick.pose, qnear=pick.near), v=pick.v)
  movej(get_inverse_kin(place.pose, qnear=place.near), v=place.v)
end
""")
SCRIPTS["approach and retract"] = S(f"""
def prog():
  W_1 = {W[1]}
  global approach = p[0, 0, -0.05, 0, 0, 0]
  movej(get_inverse_kin(pose_trans(W_1, p[0,0,-0.03,0,0,0]), qnear={V[1]}))
  movel(W_1)
  movel(pose_trans(W_1, p[0,0,-0.03,0,0,0]))
end
""")
SCRIPTS["above in the base"] = S(f"""
def prog():
  W_1 = {W[1]}
  movej(pose_add(W_1, p[0,0,0.02,0,0,0]))
  movel(W_1)
  movel(pose_add(W_1, p[0,0,0.02,0,0,0]))
end
""")
SCRIPTS["numbers in every form"] = S(f"""
def prog():
  movej({W[1]}, a=.5, v=1., t=0, r=0E0)
  W = {W[2]}
  x = -.5 + +1.0E-1 * 2 / 4 % 3
  movel(W, a=1.2e0, v=2.5E-1)
end
""")
SCRIPTS["strings that look like moves"] = S(f"""
def prog():
  textmsg("movel(p[0,0,0,0,0,0]) # not a comment")
  popup('set_tcp(p[1,0,0,0,0,0]) "quoted"', title="movej", blocking=True)
  movej({W[1]}) # movel(p[1,2,3,4,5,6])
end
""")
SCRIPTS["break and continue"] = S(f"""
def prog():
  i = 0
  while True:
    i = i + 1
    if i == 2:
      continue
    end
    if i > 3:
      break
    end
    movej({W[1]})
    movej({W[2]})
  end
  movej({W[3]})
end
""")
SCRIPTS["arguments on several lines"] = S(f"""
def prog():
  movej(
    get_inverse_kin(
      {W[1]},
      qnear = {V[1]}
    ),
    a = 1.2,  # slow
    v = 0.5
  )
end
""")
SCRIPTS["windows line ends, umlauts, tabs"] = (
    f"def prog():\r\n\t# Förderer anfahren\r\n\tmovej({W[1]})\t\r\n\r\n\tmovel({W[2]})\r\nend\r\n"
)
SCRIPTS["xor and critical sections"] = S(f"""
def prog():
  a = True
  b = False
  enter_critical
  c = a xor b
  exit_critical
  if c:
    movej({W[1]})
  end
  movej({W[2]})
end
""")
SCRIPTS["joints in degrees"] = S(f"""
def prog():
  movej({W[1]})
  movej(get_inverse_kin({W[2]}, qnear=[{", ".join(f"d2r({np.rad2deg(v):.6f})" for v in Q[2])}]))
end
""")
SCRIPTS["optimovej and optimovel"] = S(f"""
def prog():
  optimovej({W[1]}, a=0.5, v=0.5)
  optimovel({W[2]}, a=0.5, v=0.5, r=0.01)
end
""")
SCRIPTS["early return"] = S(f"""
def prog():
  def home():
    if get_standard_digital_in(0):
      return False
    end
    movej({V[1]})
    return True
  end
  ok = home()
  if not ok:
    halt
  end
  movel({W[2]})
end
""")

# --- RAPID
MODULES = {}


def M(name, data, *body, head="", end="\n"):
    return "\n".join([f"{head}MODULE {name}", *data, *body, "ENDMODULE"]) + end


PT = [f"  CONST robtarget Target_{10 * k}:={robtarget(k)};" for k in range(12)]
PT1 = [f"  CONST robtarget Target_{10 * k}:={robtarget(k, 1, 1)};" for k in range(12)]
T1W1 = ["  " + DATA[1].replace("t1", "tGripper", 1), "  " + DATA[4].replace("w1", "Workobject_1", 1)]
HEAD = """    !***********************************************************
    !
    ! Module:  Module1
    !
    ! Description:
    !   <Insert description here>
    !
    ! Author: Operator
    !
    ! Version: 1.0
    !
    !***********************************************************
"""
MODULES["RobotStudio's path"] = M(
    "Module1",
    [*T1W1, *PT1[:4], HEAD],
    """
    !***********************************************************
    !
    ! Procedure main
    !
    !   This is the entry point of your program
    !
    !***********************************************************
    PROC main()
        Path_10;
    ENDPROC
    PROC Path_10()
        MoveJ Target_10,v1000,z10,tGripper\\WObj:=Workobject_1;
        MoveL Target_20,v1000,z10,tGripper\\WObj:=Workobject_1;
        MoveL Target_30,v1000,fine,tGripper\\WObj:=Workobject_1;
    ENDPROC
""",
)
MODULES["an old header"] = "%%%\n  VERSION:1\n  LANGUAGE:ENGLISH\n%%%\n\n" + M(
    "Old", PT[1:3], "PROC main()", "  MoveJ Target_10,v100,fine,tool0;", "  MoveL Target_20,v100,fine,tool0;", "ENDPROC"
)
MODULES["system module"] = M(
    "USER(SYSMODULE,NOSTEPIN)", PT[1:3], "PROC main()", "  MoveJ Target_10,v100,fine,tool0;", "ENDPROC"
)
MODULES["speeds and zones of its own"] = M(
    "m",
    ["  CONST speeddata vSlow:=[50,500,5000,1000];", "  CONST zonedata zMine:=[FALSE,5,8,8,0.8,8,0.8];", *PT[1:4]],
    "PROC main()",
    r"  MoveJ Target_10,vSlow\T:=3,zMine\Z:=3,tool0;",
    r"  MoveL Target_20,vSlow\V:=40,fine\Inpos:=inpos50,tool0\WObj:=wobj0\TLoad:=load0;",
    "ENDPROC",
)
MODULES["home by joints"] = M(
    "m",
    [f"  CONST jointtarget jHome:={jointtarget(1)};", *PT[1:4]],
    "PROC main()",
    r"  MoveAbsJ jHome\NoEOffs,v1000,z10,tool0;",
    "  MoveL Target_20,v100,fine,tool0;",
    "ENDPROC",
)
MODULES["offsets and RelTool"] = M(
    "m",
    ["  CONST num nUp:=20;", *PT[1:4]],
    "PROC main()",
    "  MoveJ Offs(Target_10,0,0,nUp),v1000,z10,tool0;",
    "  MoveL Target_10,v100,fine,tool0;",
    r"  MoveL RelTool(Target_20,0,0,-20\Rz:=5),v100,fine,tool0;",
    "ENDPROC",
)
MODULES["offsets alone"] = M(
    "m",
    ["  CONST num nUp:=20;", *PT[1:4]],
    "PROC main()",
    "  MoveJ Offs(Target_10,0,0,nUp),v1000,z10,tool0;",
    "  MoveL Offs(Target_20,0,-nUp,2*nUp),v100,fine,tool0;",
    r"  MoveL RelTool(Target_30,0,0,-20\Rz:=5),v100,fine,tool0;",
    "ENDPROC",
)
MODULES["test and case"] = M(
    "m",
    ["  PERS num nPart:=2;", *PT[1:4]],
    "PROC main()",
    "  TEST nPart",
    "  CASE 1:",
    "    MoveJ Target_10,v100,fine,tool0;",
    "  CASE 2,3:",
    "    MoveJ Target_20,v100,fine,tool0;",
    "  DEFAULT:",
    '    TPWrite "MoveL wrong part";',
    "    Stop;",
    "  ENDTEST",
    "ENDPROC",
)
MODULES["arc welding"] = M(
    "m",
    [
        *T1W1,
        "  TASK PERS seamdata sm1:=[0.5,0.5,[5,0],0,0];",
        "  TASK PERS welddata wd1:=[10,0,[5,0,24],[0,0,0]];",
        *PT1[1:4],
    ],
    "PROC main()",
    r"  MoveJ Target_10,v100,z10,tGripper\WObj:=Workobject_1;",
    r'  ArcLStart Target_20,v100,sm1,wd1,fine,tGripper\WObj:=Workobject_1\SeamName:="seam1";',
    r"  ArcL Target_10,v100,sm1,wd1,z10,tGripper\WObj:=Workobject_1;",
    r"  ArcLEnd Target_30,v100,sm1,wd1,fine,tGripper\WObj:=Workobject_1;",
    "ENDPROC",
)
MODULES["triggers"] = M(
    "m",
    ["  VAR triggdata trGlue;", *PT[1:4]],
    "PROC main()",
    r"  TriggIO trGlue,5\Start\DOp:=doGlue,1;",
    "  MoveJ Target_10,v100,z10,tool0;",
    "  TriggL Target_20,v100,trGlue,fine,tool0;",
    "  TriggJ Target_30,v100,trGlue,fine,tool0;",
    "ENDPROC",
)
MODULES["array in a loop"] = M(
    "m",
    [f"  PERS robtarget pPlace{{4}}:=[{robtarget(1)},{robtarget(2)},", f"    {robtarget(3)},{robtarget(4)}];"],
    "PROC main()",
    "  FOR i FROM 1 TO 4 STEP 1 DO",
    "    MoveJ pPlace{i},v100,fine,tool0;",
    "  ENDFOR",
    "  FOR i FROM Dim(pPlace,1) TO 1 DO",
    "    MoveJ pPlace{i},v100,fine,tool0;",
    "  ENDFOR",
    "ENDPROC",
)
MODULES["array of two dimensions"] = M(
    "m",
    [f"  CONST robtarget pGrid{{2,2}}:=[[{robtarget(1)},{robtarget(2)}],[{robtarget(3)},{robtarget(4)}]];"],
    "PROC main()",
    "  FOR r FROM 1 TO 2 DO",
    "    FOR c FROM 1 TO 2 DO",
    "      MoveJ pGrid{r,c},v100,fine,tool0;",
    "    ENDFOR",
    "  ENDFOR",
    "ENDPROC",
)
MODULES["configurations not watched"] = M(
    "m",
    PT[1:4],
    "PROC main()",
    r"  ConfL\Off;",
    r"  ConfJ\Off;",
    r"  SingArea\Wrist;",
    "  MoveJ Target_10,v100,fine,tool0;",
    "  MoveL Target_20,v100,fine,tool0;",
    "ENDPROC",
)
MODULES["a trap of signals"] = M(
    "m",
    ["  VAR intnum iStop;", *PT[1:4]],
    "PROC main()",
    "  CONNECT iStop WITH tStop;",
    "  ISignalDI diStop,1,iStop;",
    "  MoveJ Target_10,v100,fine,tool0;",
    "  IDelete iStop;",
    "ENDPROC",
    "TRAP tStop",
    "  SetDO doLamp,1;",
    "ENDTRAP",
)
MODULES["an error handler with retry"] = M(
    "m",
    PT[1:4],
    "PROC main()",
    "  MoveJ Target_10,v100,fine,tool0;",
    r"  WaitDI diPart,1\MaxTime:=5;",
    "  MoveL Target_20,v100,fine,tool0;",
    "ERROR",
    "  IF ERRNO=ERR_WAIT_MAXTIME THEN",
    '    TPWrite "no part";',
    "    RETRY;",
    "  ENDIF",
    "  RAISE;",
    "ENDPROC",
)
MODULES["function of robtargets"] = M(
    "m",
    PT[1:4],
    "PROC main()",
    "  MoveJ pOf(2),v100,fine,tool0;",
    "  MoveJ pOf(1),v100,fine,tool0;",
    "ENDPROC",
    "FUNC robtarget pOf(num n)",
    "  TEST n",
    "  CASE 1:",
    "    RETURN Target_10;",
    "  DEFAULT:",
    "    RETURN Target_20;",
    "  ENDTEST",
    "ENDFUNC",
)
MODULES["local data and routines"] = M(
    "m",
    ["  LOCAL " + p.strip() for p in PT[1:4]],
    "LOCAL PROC rGo()",
    "  VAR robtarget pNow;",
    "  pNow:=Target_20;",
    "  MoveJ pNow,v100,fine,tool0;",
    "ENDPROC",
    "PROC main()",
    "  MoveJ Target_10,v100,fine,tool0;",
    "  rGo;",
    "ENDPROC",
)
MODULES["names in other cases"] = M(
    "m",
    PT[1:4],
    "PROC Main()",
    "  MOVEJ TARGET_10,V100,FINE,TOOL0;",
    "  movel target_20,v100,fine,tool0\\wobj:=WOBJ0;",
    "ENDPROC",
)
MODULES["latin-1 and windows line ends"] = M(
    "m",
    ["  ! Förderband", *PT[1:4]],
    "PROC main()",
    '  TPWrite "Größe";',
    "  MoveJ Target_10,v100,fine,tool0;",
    "ENDPROC",
).replace("\n", "\r\n")
MODULES["strings with quotes"] = M(
    "m",
    PT[1:4],
    "PROC main()",
    '  TPWrite "say ""MoveL p10"" ! no comment";',
    '  TPWrite "path C:\\\\x";',
    "  MoveJ Target_10,v100,fine,tool0;",
    "ENDPROC",
)
MODULES["conc, move and do, ID"] = M(
    "m",
    PT[1:4],
    "PROC main()",
    r"  MoveJ\Conc,Target_10,v100,z10,tool0;",
    "  MoveLDO Target_20,v100,fine,tool0,doGlue,1;",
    "ENDPROC",
)
MODULES["search without use of the point"] = M(
    "m",
    ["  VAR robtarget pFound;", *PT[1:4]],
    "PROC main()",
    "  MoveJ Target_10,v100,fine,tool0;",
    r"  SearchL\Stop,diProbe,pFound,Target_20,v20,tool0;",
    "  MoveJ Target_30,v100,fine,tool0;",
    "ENDPROC",
)
MODULES["optional work object and present"] = M(
    "m",
    [*T1W1, *PT1[1:4]],
    "PROC main()",
    r"  rGo Target_10\WObj:=Workobject_1;",
    "ENDPROC",
    r"PROC rGo(robtarget p\PERS wobjdata WObj)",
    r"  IF Present(WObj) THEN",
    r"    MoveJ p,v100,fine,tGripper\WObj?WObj;",
    "  ENDIF",
    "ENDPROC",
)
MODULES["load and payload"] = M(
    "m",
    ["  PERS loaddata ldPart:=[2,[0,0,50],[1,0,0,0],0,0,0];", *PT[1:4]],
    "PROC main()",
    "  AccSet 50,50;",
    "  VelSet 80,1000;",
    "  GripLoad ldPart;",
    "  MoveJ Target_10,v100,fine,tool0;",
    "  GripLoad load0;",
    "ENDPROC",
)
MODULES["part assigned whole"] = M(
    "m",
    ["  VAR robtarget p;", *PT[1:4]],
    "PROC main()",
    "  p:=Target_10;",
    "  MoveJ p,v100,fine,tool0;",
    "  p:=Target_20;",
    "  MoveJ p,v100,fine,tool0;",
    "ENDPROC",
)
MODULES["placeholders"] = M(
    "m", ["  <DDN>", *PT[1:4]], "PROC main()", "  MoveJ Target_10,v100,fine,tool0;", "  <SMT>", "ENDPROC", "<RDN>"
)
MODULES["many numbers of digits"] = M(
    "m",
    [
        f"  CONST robtarget a:=[{mm(POSES[1])},[{','.join(str(int(np.floor(Q[1][k] / (0.5 * np.pi)))) for k in (0, 3, 5))},0],[9E+09,9E+09,9E+09,9E+09,9E+09,9E+09]];"
    ],
    "PROC main()",
    "  MoveJ a,v100,fine,tool0;",
    "ENDPROC",
)
MODULES["record of a station"] = M(
    "m",
    [
        "  RECORD station",
        "    robtarget pPick;",
        "    num nWait;",
        "    string sName;",
        "  ENDRECORD",
        f'  PERS station st{{2}}:=[[{robtarget(1)},0.5,"A"],[{robtarget(2)},1,"B"]];',
    ],
    "PROC main()",
    "  FOR i FROM 1 TO 2 DO",
    "    MoveJ st{i}.pPick,v100,fine,tool0;",
    "    WaitTime st{i}.nWait;",
    "  ENDFOR",
    "ENDPROC",
)
MODULES["undo and backward"] = M(
    "m",
    PT[1:4],
    "PROC main()",
    "  rGo;",
    "ENDPROC",
    "PROC rGo()",
    "  MoveJ Target_10,v100,fine,tool0;",
    "BACKWARD",
    "  MoveL Target_20,v100,fine,tool0;",
    "UNDO",
    "  SetDO doGrip,0;",
    "ENDPROC",
)


SPLIT = ("above in the base", "offsets and RelTool")  # a target and a point beside it need different numbers


@pytest.mark.parametrize(
    ("name", "suffix"), [*((name, "script") for name in SCRIPTS), *((name, "mod") for name in MODULES)]
)
def test_programs_of_the_vendors_are_corrected(tmp_path, name, suffix):
    text = (SCRIPTS if suffix == "script" else MODULES)[name]
    after = corrected(tmp_path, text, suffix, split=name in SPLIT).text.decode("latin-1")
    if name not in SPLIT:
        assert NUMBER.sub("#", after) == NUMBER.sub("#", text)
    asked = driven(text, suffix)
    assert missed(asked, asked)[:, 0].max() > 5e-3
    assert missed(asked, driven(after, suffix)).max() < 1e-6


UNKNOWN_SCRIPTS = {}


def u(name, *body, more=()):
    UNKNOWN_SCRIPTS[name] = (
        "def prog():\n" + "\n".join("  " + line for line in (f"movej({W[1]})", *body, f"movel({W[4]})")) + "\nend\n"
    )


A, B, C = W[2], W[3], W[5]
u("height from a register", "h = read_input_float_register(0) ^", f"movel(pose_add({A}, p[0,0,h,0,0,0])) ~")
u("pose of a list from a socket", "r = socket_read_ascii_float(6) ^", "movel(p[r[1],r[2],r[3],r[4],r[5],r[6]]) ~")
u("element set from an input", f"V1 = {A}", "V1[2] = read_input_float_register(3) ^", "movel(V1) ~")
u(
    "element set in a branch",
    f"V1 = {A}",
    "if get_standard_digital_in(0): ^",
    "  V1[0] = V1[0] + get_analog_in(0) ^",
    "end ^",
    "movel(V1) ~",
)
u(
    "feature from a camera",
    'cam = rpc_factory("xmlrpc", "http://127.0.0.1:50000/RPC2") ^',
    "F = cam.get_pose() ^",
    f"movel(pose_trans(F, {A})) ~",
)
u("urcap's function", "urcap_gripper_move(3) ~")
u("feature from the installation", f"movel(pose_trans(Feature_of_installation, {A})) ~")
u("waypoint of the installation", "movej(get_inverse_kin(Home_p, qnear=Home_q)) ~")
u("relative to where it was", "start = get_actual_tcp_pose() ^", "movel(pose_trans(start, p[0,0,0.05,0,0,0])) ~")
u("back to where it was in joints", "start = get_actual_joint_positions() ^", "movej(start) ~")
u("joints plus a step", "q = get_target_joint_positions() ^", "q[5] = q[5] + 0.1 ^", "movej(q) ~")
u("forward kinematics", f"movel(get_forward_kin({V[2]})) ~")
u("interpolated", f"movel(interpolate_pose({A}, {B}, 0.5)) ~")
u(
    "moves along a stack",
    f"V1 = {A}",
    "while get_standard_digital_in(0): ^",
    "  movel(V1) ~",
    "  V1 = pose_trans(V1, p[0,0,-0.01,0,0,0]) ^",
    "end ^",
)
u(
    "index from an input",
    f"path = [{A}, {B}]",
    "k = read_input_integer_register(1) ^",
    "movel(pose_add(path[0], p[0,0,k,0,0,0])) ~",
)
u(
    "tool from a register",
    "set_tcp(p[0,0,read_input_float_register(2),0,0,0]) ^",
    f"movel({A}) ~",
    f"set_tcp(p{written(TOOLS[0])})",
)
u(
    "tool of a changer",
    "if get_standard_digital_in(1): ^",
    "  set_tcp(measured_tool()) ~",
    "end ^",
    f"movel({A}) ~",
    f"set_tcp(p{written(TOOLS[0])})",
)
u("speed", "speedl([0,0,-0.02,0,0,0], 0.5, 0.5) ~", "stopl(1.0)")
u("hand guided", "freedrive_mode() ~", "sleep(5)", "end_freedrive_mode()")
u("force", "force_mode(tool_pose(), [0,0,1,0,0,0], [0,0,10,0,0,0], 2, [1,1,1,1,1,1]) ~", "end_force_mode()")
u("screw driving", "screw_driving(3, 5.0, 0.01) ~", "end_screw_driving()")
u("servo by a register", "servoj([0,-1.5,1.5,0,read_input_float_register(0),0], t=0.008) ~")
u("path offset", "path_offset_enable() ~", "path_offset_disable()")
u(
    "struct's field from a sensor",
    f"part = struct(pose={A}, ok=True)",
    "part.pose = cam_pose(1) ~",
    "movel(part.pose) ~",
)
u(
    "a thread changes it",
    f"global G1 = {A}",
    "thread Look():",
    "  while True:",
    f"    global G1 = pose_add({B}, p[0,0,get_analog_in(0),0,0,0])",
    "    sync()",
    "  end",
    "end",
    "run Look() ^",
    "movel(G1) ~",
)
u(
    "a thread sets the tool's pose by hand",
    f"global G1 = {A}",
    "thread Look():",
    "  G1[2] = 0.4",
    "end",
    "h = run Look() ^",
    "movel(G1) ~",
    "join h ^",
)
u("computed circle", f"movec(get_target_tcp_pose(), {A}) ~")
u(
    "a function that measures",
    "def look():",
    f"  return pose_trans({A}, p[0,0,get_analog_in(1),0,0,0])",
    "end",
    "movel(look()) ~",
)
u("a condition reads its numbers", f"V1 = {A}", "if V1[2] > 0.1:", "  movel(V1) ~", "end")
u(
    "a function of a condition reads its numbers",
    "def above(at):",
    "  return at[2] > 0.1",
    "end",
    f"V1 = {A}",
    "high = above(V1)",
    "if above(V1):",
    "  movel(V1) ~",
    "end",
)
u(
    "a loop's condition reads its numbers",
    f"V1 = {A}",
    "movel(V1) ~",
    "while V1[2] < -5.0:",
    f"  movel({B})",
    "end",
)
u(
    "a palette",
    "i = 0 ^",
    "while i < 3: ^",
    f"  movel(pose_trans({A}, p[0.01*i,0,0,0,0,0])) ~",
    "  i = i + 1 ^",
    "end ^",
)
u(
    "a script sent to a second controller",
    'socket_open("192.168.0.3", 30002, "other") ^',
    'socket_send_line("movej([0,0,0,0,0,0])", "other") ~',
)

UNKNOWN_MODULES = {}


def r(name, *body, data=(), more=()):
    UNKNOWN_MODULES[name] = "\n".join(
        [
            "MODULE Work",
            *DATA,
            *PT[1:6],
            *data,
            "PROC main()",
            "  MoveJ Target_10,v100,fine,t0;",
            *("  " + b for b in body),
            "  MoveJ Target_40,v100,fine,t0;",
            "ENDPROC",
            *more,
            "ENDMODULE",
            "",
        ]
    )


r("height from a sensor", "MoveL Offs(Target_20,0,0,AInput(aiHeight)),v100,fine,t0; ~")
r(
    "height typed in",
    r'TPReadNum nHigh,"height?"; ^',
    "MoveL Offs(Target_20,0,0,nHigh),v100,fine,t0; ~",
    data=["VAR num nHigh;"],
)
r(
    "a condition reads its numbers",
    "MoveL Target_20,v100,fine,t0; ~",
    "IF Target_20.trans=[1,2,3] OR Target_20.trans.z>100 THEN",
    "MoveL Target_30,v100,fine,t0;",
    "ENDIF",
)
r("height counted up", "Add nHigh,5; ^", "MoveL Offs(Target_20,0,0,nHigh),v100,fine,t0; ~", data=["PERS num nHigh:=0;"])
r("where it is", "pNow:=CRobT(\\Tool:=t0); ^", "MoveL Offs(pNow,0,0,50),v100,fine,t0; ~", data=["VAR robtarget pNow;"])
r(
    "joints where it is",
    "jNow:=CJointT(); ^",
    "jNow.robax.rax_6:=0; ^",
    "MoveAbsJ jNow,v100,fine,t0; ~",
    data=["VAR jointtarget jNow;"],
)
r(
    "found by a search",
    r"SearchL\Stop,diProbe,pFound,Target_20,v20,t0;",
    "MoveL Offs(pFound,0,0,-5),v100,fine,t0; ~",
    data=["VAR robtarget pFound;"],
)
r(
    "displaced",
    "PDispSet peShift; ^",
    "MoveJ Target_20,v100,fine,t0; ~",
    "PDispOff;",
    data=["VAR pose peShift:=[[0,0,10],[1,0,0,0]];"],
)
r(
    "displaced by two targets",
    r"PDispOn\ExeP:=Target_20,Target_30,t0; ^",
    "MoveJ Target_30,v100,fine,t0; ~",
    "PDispOff;",
)
r("external offset", "EOffsSet eax; ^", "MoveJ Target_20,v100,fine,t0; ~", "EOffsOff;", data=["VAR extjoint eax;"])
r("tool of the controller", "MoveJ Target_20,v100,fine,CTool(); ~")
r("tool of another module", "MoveJ Target_20,v100,fine,tOther; ~")
r("work object of another module", r"MoveJ Target_20,v100,fine,t0\WObj:=wOther; ~")
r(
    "work object measured",
    "w1.oframe.trans.x:=w1.oframe.trans.x+nVision; ^",
    r"MoveJ Target_20,v100,fine,t0\WObj:=w1; ~",
    data=["VAR num nVision;"],
)
r(
    "work object from three points",
    "w1.uframe:=DefFrame(Target_10,Target_20,Target_30); ^",
    r"MoveJ Target_20,v100,fine,t0\WObj:=w1; ~",
)
r(
    "work object on a conveyor",
    r"MoveJ Target_20,v100,fine,t0\WObj:=wConv; ~",
    data=['PERS wobjdata wConv:=[FALSE,FALSE,"CNV1",[[0,0,0],[1,0,0,0]],[[0,0,0],[1,0,0,0]]];'],
)
r(
    "stationary tool",
    "MoveJ Target_20,v100,fine,tFix; ~",
    data=["PERS tooldata tFix:=[FALSE,[[0,0,0],[1,0,0,0]],[1,[0,0,1],[1,0,0,0],0,0,0]];"],
)
r(
    "a track under the robot",
    "MoveJ pTrack,v100,fine,t0; ~",
    data=[f"CONST robtarget pTrack:={robtarget(2).replace('[9E9,', '[1200,')};"],
)
r("a camera's target", "MoveJ GetPart(1),v100,fine,t0; ~")
r("a routine of another module", "GripClose 3; ~")
r("a routine by name", '%"rPart"+NumToStr(1,0)%; ~')
r("a routine by number", 'CallByVar "rPart",nPart; ~', data=["VAR num nPart:=1;"])
r("loaded at run time", r'Load\Dynamic,"HOME:/part.mod"; ^', '%"part:main"%; ~')
r("guided path", "EGMRunPose egmID1,EGM_STOP_RAMP_DOWN; ~", data=["VAR egmident egmID1;"])
r("corrected by a sensor", r"MoveL Target_20,v100,fine,t0\Corr; ~")
r("declared without a value", "MoveJ pEmpty,v100,fine,t0; ~", data=["PERS robtarget pEmpty;"])
r(
    "read from a file",
    r'Open "HOME:"\File:="p.txt",fil\Read; ^',
    "pNow.trans.x:=ReadNum(fil); ^",
    "MoveJ pNow,v100,fine,t0; ~",
    data=["VAR iodev fil;", f"VAR robtarget pNow:={robtarget(2)};"],
)
r(
    "changed by a trap",
    "MoveJ pNow,v100,fine,t0; ~",
    data=[f"PERS robtarget pNow:={robtarget(2)};"],
    more=["TRAP tSee", "  pNow.trans.z:=nSee;", "ENDTRAP"],
)
r(
    "changed by reference",
    "rMeasure pNow; ^",
    "MoveJ pNow,v100,fine,t0; ~",
    data=[f"VAR robtarget pNow:={robtarget(2)};"],
    more=["PROC rMeasure(INOUT robtarget p)", "  p.trans.z:=p.trans.z+AInput(aiHeight);", "ENDPROC"],
)
r(
    "unpacked from bytes",
    "UnpackRawBytes raw,1,x\\Float4; ^",
    "MoveL Offs(Target_20,x,0,0),v100,fine,t0; ~",
    data=["VAR rawbytes raw;", "VAR num x;"],
)
r("mirrored", "MoveJ MirPos(Target_20,peMirror),v100,fine,t0; ~", data=["VAR pose peMirror:=[[0,0,10],[1,0,0,0]];"])
r(
    "turned by a vector",
    "pNow.rot:=qMeasured*pNow.rot; ^",
    "MoveJ pNow,v100,fine,t0; ~",
    data=[f"VAR robtarget pNow:={robtarget(2)};", "VAR orient qMeasured;"],
)
r("a palette by two counters", "FOR i FROM 0 TO 2 DO ^", "MoveJ Offs(Target_20,i*10,0,0),v100,fine,t0; ~", "ENDFOR ^")


MARK = re.compile(r" [~^]$")


@pytest.mark.parametrize(
    ("name", "suffix"), [*((name, "script") for name in UNKNOWN_SCRIPTS), *((name, "mod") for name in UNKNOWN_MODULES)]
)
def test_one_thing_that_only_the_run_knows(tmp_path, name, suffix):
    lines = (UNKNOWN_SCRIPTS if suffix == "script" else UNKNOWN_MODULES)[name].splitlines()
    refused = {number for number, line in enumerate(lines, start=1) if line.endswith(" ~")}
    left_out = {number for number, line in enumerate(lines, start=1) if MARK.search(line)}
    plain = [MARK.sub("", line) for line in lines]
    text = "\n".join([*plain, ""])
    with pytest.raises(ProgramRefused) as caught:
        corrected(tmp_path, text, suffix)
    assert {one.line for one in caught.value.refused} == refused
    found = corrected(tmp_path, text, suffix, partial=True)
    after = found.text.decode("latin-1").splitlines()
    assert {one.line for one in found.refused} == refused
    assert len(after) == len(plain)
    asked, done = (
        "\n".join([line for number, line in enumerate(each, start=1) if number not in left_out] + [""])
        for each in (plain, after)
    )
    assert missed(driven(asked, suffix), driven(done, suffix)).max() < 1e-6
