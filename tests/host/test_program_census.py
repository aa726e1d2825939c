"""Adversarial programs: each move is corrected in its literal (K), gets numbers of its own (O), or is refused (R).

A made-up robot error that changes with the place takes the place of the robot. Whatever is written is read again, and
no byte outside numbers changes unless a move gets numbers of its own.
"""

import re

import numpy as np
import pytest

from truearm.correct.programs.census import Census
from truearm.correct.programs.corrected_text import Joints, changed_files, changes_of, difference, target_poses
from truearm.correct.programs.languages import read_programs
from truearm.correct.programs.program import Surroundings
from truearm.correct.programs.reading import readings_of
from truearm.correct.programs.tokens import Source
from truearm.model.transforms import frame_of, inverted

NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")
MARK = re.compile(r"[!#;] ?([KOR])\b")
OTHER_TASK = ""  # the files after it are another task's
TOOLS = "MODULE m\nPERS tooldata t1:=[TRUE,[[0,0,100],[1,0,0,0]],[1,[0,0,1],[1,0,0,0],0,0,0]];\nPERS tooldata t2:=[TRUE,[[0,0,200],[1,0,0,0]],[1,[0,0,1],[1,0,0,0],0,0,0]];\n"
WORK = 'PERS wobjdata w1:=[FALSE,TRUE,"",[[100,0,0],[1,0,0,0]],[[0,0,0],[1,0,0,0]]];\n'


def target(x, y=0):
    return f"[[{x},{y},300],[0,0,1,0],[0,0,0,0],[9E9,9E9,9E9,9E9,9E9,9E9]]"


POINTS = "".join(f"CONST robtarget p{k}:={target(300 + k, k)};\n" for k in (1, 2, 3))
POINTS += "".join(f"VAR robtarget v{k}:={target(400 + k, k)};\n" for k in (1, 2, 3))
POINTS += "CONST jointtarget j1:=[[0,10,20,0,30,0],[9E9,9E9,9E9,9E9,9E9,9E9]];\n"


def module(body, data="", routines=""):
    """Return a module whose main has a body; ~ stands for the end of a move with tool t1."""
    return f"{TOOLS}{WORK}{POINTS}{data}PROC main()\n{body}\nENDPROC\n{routines}ENDMODULE\n"


def script(body, head="set_tcp(p[0,0,0.1,0,0,0])\n"):
    """Return a script with the points a and b."""
    return f"def main():\n{head}a=p[0.4,0.1,0.3,0,3.1,0]\nb=p[0.5,-0.1,0.3,0,3.1,0]\n{body}\nend\n"


FRAMES = "TOOL_DATA[1]={X 0,Y 0,Z 100,A 0,B 0,C 0}\nBASE_DATA[2]={X 10,Y 0,Z 0,A 0,B 0,C 0}\n"
KRL_POINTS = 'DEFDAT p\nDECL E6POS XP1={X 400,Y 10,Z 300,A 0,B 90,C 0,S 2,T 2,E1 0.0,E2 0.0}\nDECL E6POS XP2={X 450,Y 20,Z 300,A 0,B 90,C 0,S 2,T 2,E1 0.0}\nDECL FDAT FP1={TOOL_NO 1,BASE_NO 2,IPO_FRAME #BASE,POINT2[] " "}\nDECL E6AXIS XHOME={A1 5,A2 -90,A3 100,A4 5,A5 10,A6 5}\nENDDAT\n'
KRL_ARRAY = f"{KRL_POINTS}DECL E6POS XA[3]\n"
KRL_ARRAY += "".join(f"XA[{k}]={{X 4{k}0,Y 10,Z 300,A 0,B 90,C 0,S 2,T 2}}\n" for k in (1, 2, 3))


def krl(body, data=KRL_POINTS, config=FRAMES):
    """Return a program with its data and the controller's."""
    return {"p.src": f"DEF p()\n{body}\nEND\n", "p.dat": data, "$config.dat": config}


LS_POINTS = (
    "/POS\n"
    + "".join(
        f"P[{k}{{\"a\"}}]{{\n   GP1:\n\tUF : 0, UT : 1,\t\tCONFIG : 'N U T, 0, 0, 0',\n\tX =   {400 + k}.0  mm,\tY =   10.0  mm,\tZ =   300.0  mm,\n\tW =   180.0 deg,\tP =    0.0 deg,\tR =   0.0 deg\n}};\n"
        for k in (1, 2, 3)
    ).replace('{"a"}', "")
    + "/END\n"
)


def ls(body, points=LS_POINTS):
    """Return a program of lines without numbers and semicolons."""
    lines = "".join(f"   {k}:  {line} ;\n" for k, line in enumerate(body.splitlines(), start=1))
    return {"p.ls": f"/PROG P\n/MN\n{lines}{points}"}


RAPID = {
    "plain": [module('MoveL p1,v100,z1,t1\\WObj:=w1; !K\nMoveJ v1,~ !K')],
    "EOffsSet in another module": [module('MoveL p1,~ !R'),'MODULE b\nPROC x()\nEOffsSet e1;\nENDPROC\nENDMODULE\n'],
    "PDispOn \\Rot": [module('PDispOn\\Rot, p1, t1;\nMoveL p2,~ !R\nMoveAbsJ j1,v1,z1,t1; !K')],
    "tool reassigned in a TRAP": [module('MoveL p1,~ !R','',"TRAP tr\nt1:=t2;\nENDTRAP\n")],
    "tool component assigned in another module": [module('MoveL p1,~ !R'),'MODULE b\nPROC x()\nt1.tframe.trans.z:=150;\nENDPROC\nENDMODULE\n'],
    "tool measured": [module('MToolTCPCalib j1,j1,j1,j1,t1,e,e2; !R\nMoveL p1,~ !R')],
    "TPWrite of the point": [module('MoveL v1,~ !O\nTPWrite "x"\\Pos:=v1.trans;')],
    "component assigned": [module('v1.trans.x:=5;\nMoveL v1,~ !R')],
    "nothing is assigned": [module('v1:=;\nMoveL v1,~ !R\nMoveL p1,~ !K')],
    "component read by IF": [module('IF v1.trans.x > 3 THEN\nMoveL v1,~ !O\nENDIF')],
    "AND before a bracket reads": [module('IF x>3 AND (v1.trans.x>3) THEN\nMoveL v1,~ !O\nENDIF')],
    "compact IF reads": [module('IF p1.trans.x>3 MoveL p2,~ !K\nMoveL p1,~ !O')],
    "array in a loop, one tool": [module('FOR i FROM 1 TO 2 DO\nMoveL a{i},~ !K\nENDFOR','CONST robtarget a{2}:=['+target(1,2)+','+target(3,4)+'];\n')],
    "array in a loop, element assigned": [module('a{2}:=p1;\nFOR i FROM 1 TO 2 DO\nMoveL a{i},~ !R\nENDFOR','VAR robtarget a{2}:=['+target(1,2)+','+target(3,4)+'];\n')],
    "array, two tools": [module('FOR i FROM 1 TO 2 DO\nMoveL a{i},~ !K\nENDFOR\nMoveL a{1},v100,z1,t2; !O','CONST robtarget a{2}:=['+target(301,2)+','+target(3,4)+'];\n')],
    "loop counter named as a point": [module('FOR p1 FROM 1 TO 2 DO\nMoveL p1,~ !R\nENDFOR')],
    "loop counter hides a name in its loop alone": [module('FOR v1 FROM 1 TO 2 DO\nMoveL p1,~ !K\nENDFOR\nMoveL v1,~ !K')],
    "array copied": [module('b:=a;\nFOR i FROM 1 TO 2 DO\nMoveL b{i},~ !K\nENDFOR','CONST robtarget a{2}:=['+target(1,2)+','+target(3,4)+'];\nVAR robtarget b{2};\n')],
    "offset counts": [module('FOR i FROM 1 TO 2 DO\nMoveL Offs(p1,0,0,i*10),~ !R\nENDFOR\nMoveL p1,~ !O')],
    "offset constant near": [module('MoveL Offs(p1,0,0,1),~ !K\nMoveL p1,~ !K')],
    "offset constant far": [module('MoveL Offs(p1,0,0,400),~ !O\nMoveL p1,~ !K')],
    "RelTool with Rz": [module('MoveL RelTool(p1,0,0,5\\Rz:=10),~ !K')],
    "LOCAL shadows": [TOOLS + f'LOCAL CONST robtarget p:={target(1)};\nPROC x()\nMoveL p,~ !K\nENDPROC\nENDMODULE\n',f'MODULE b\nCONST robtarget p:={target(2)};\nPROC y()\nMoveL p,~ !K\nENDPROC\nENDMODULE\n'],
    "routine data shadows": [module('VAR robtarget p1;\np1:=CRobT();\nMoveL p1,~ !R','','PROC z()\nMoveL p1,~ !K\nENDPROC\n')],
    "parameter shadows": [module('z p2;','','PROC z(robtarget p1)\nMoveL p1,~ !R\nENDPROC\nPROC y()\nMoveL p1,~ !K\nMoveL p2,~ !O\nENDPROC\n')],
    "same global name in two modules, used in a third": [module('MoveL q,~ !R'),f'MODULE b\nCONST robtarget q:={target(1)};\nENDMODULE\n',f'MODULE c\nCONST robtarget q:={target(2)};\nENDMODULE\n'],
    "tool passed to an unknown routine": [module('Grip t1;\nMoveL p1,~ !R')],
    "SetDataVal by name": [module('SetDataVal "v1",v2;\nMoveL v1,~ !R\nMoveL p1,v100,z1,tool0; !K')],
    "late bound call with argument": [module('%"x"% v1;\nMoveL v1,~ !R')],
    "held work object": [module('MoveL p1,v1,z1,t1\\WObj:=wh; !R\nMoveL p1,~ !O','PERS wobjdata wh:=[TRUE,TRUE,"",[[0,0,0],[1,0,0,0]],[[0,0,0],[1,0,0,0]]];\n')],
    "stationary tool": [module('MoveL p1,v1,z1,ts; !R','PERS tooldata ts:=[FALSE,[[0,0,0],[1,0,0,0]],[1,[0,0,1],[1,0,0,0],0,0,0]];\n')],
    "work object on a mechanical unit": [module('MoveL p1,v1,z1,t1\\WObj:=wm; !R','PERS wobjdata wm:=[FALSE,FALSE,"STN1",[[0,0,0],[1,0,0,0]],[[0,0,0],[1,0,0,0]]];\n')],
    "work object computed": [module('w1.oframe:=DefFrame(p1,p2,p3);\nMoveL v1,v1,z1,t1\\WObj:=w1; !R\nMoveL p1,~ !O')],
    "external axis": [module('MoveL x1,~ !R','CONST robtarget x1:=[[1,2,3],[1,0,0,0],[0,0,0,0],[120,9E9,9E9,9E9,9E9,9E9]];\n')],
    "SingArea LockAxis4": [module('SingArea\\LockAxis4;\nMoveL p1,~ !R')],
    "Corr": [module('MoveL p1,v1,z1,t1\\Corr; !R')],
    "two tools, one point": [module('MoveL p1,v1,z1,t1; !K\nMoveL p1,v1,z1,t2; !O')],
    "declared in terms of names": [module('MoveL n1,~ !R','CONST num x0:=5;\nCONST robtarget n1:=[[x0,0,0],[1,0,0,0],[0,0,0,0],[9E9,9E9,9E9,9E9,9E9,9E9]];\n')],
    "IPers on the tool": [module('CONNECT i WITH tr;\nIPers t1,i;\nMoveL p1,~ !R')],
    "PERS assigned in another task": [module('MoveL q,v1,z1,t1; !R','PERS robtarget q:='+target(5)+';\n'), OTHER_TASK, ('MODULE o\nPERS robtarget q:='+target(5)+';\nPROC x()\nq.trans.x:=1;\nENDPROC\nENDMODULE\n')],
    "PERS with other numbers in another task": [module('MoveL p1,v1,z1,tq; !R','PERS tooldata tq:=[TRUE,[[0,0,100],[1,0,0,0]],[1,[0,0,1],[1,0,0,0],0,0,0]];\n'), OTHER_TASK, ('MODULE o\nPERS tooldata tq:=[TRUE,[[0,0,150],[1,0,0,0]],[1,[0,0,1],[1,0,0,0],0,0,0]];\nENDMODULE\n')],
    "WObj of an optional parameter": [module('','','PROC z(\\PERS wobjdata w)\nMoveL p1,v1,z1,t1\\WObj?w; !R\nENDPROC\n')],
    "tool of a routine parameter": [module('z t1;','','PROC z(PERS tooldata t)\nMoveL p1,v1,z1,t; !R\nENDPROC\n')],
    "declared twice in a module": [module('MoveL d1,~ !R',f'CONST robtarget d1:={target(1)};\nCONST robtarget d1:={target(2)};\n')],
    "component of a point as offset": [module('MoveL Offs(p1,0,0,p2.trans.z),~ !R\nMoveL p2,~ !O')],
    "ERROR handler assigns": [module('MoveL v1,~ !R\nERROR\nv1:=CRobT();\nRETRY;')],
    "MoveC": [module('MoveC p1,p2,~ !K')],
    "p := p2, other tool": [module('v1:=v2;\nMoveL v2,v1,z1,t2; !O\nMoveL v1,~ !R')],
    "p := Offs(p)": [module('v1:=Offs(v1,0,0,10);\nMoveL v1,~ !R')],
    "p := p2 then read": [module('v1:=v2;\nMoveL v1,~ !R\nx:=v1.trans;')],
    "tool := same numbers": [module('t1:=t3;\nMoveL p1,~ !K','PERS tooldata t3:=[TRUE,[[0,0,100],[1,0,0,0]],[1,[0,0,1],[1,0,0,0],0,0,0]];\n')],
    "p := CRobT": [module('v1:=CRobT();\nMoveL v1,~ !R')],
    "p := p2 then component": [module('v1:=p2;\nv1.trans.z:=9;\nMoveL v1,~ !R\nMoveL p2,~ !O')],
    "multiplied frame": [module('MoveL p1,v1,z1,t1\\WObj:=w1; !K\nMoveL p1,~ !O')],
}  # fmt: skip
URSCRIPT = {
    "plain": [script('movel(a,v=1) #K\nmovej(get_inverse_kin(b,qnear=[0,0,0,0,0,0])) #K\nmovej(p[0.1,0.2,0.3,0,3,0]) #K')],
    "pose_add on itself": [script('a=pose_add(a,p[0,0,0.1,0,0,0])\nmovel(a) #R')],
    "assigned in a thread": [script('thread t():\na[2]=0.5\nend\nrun t()\nmovel(a) #R\nmovel(b) #K')],
    "global assigned in a function": [script('def f():\nglobal a=b\nend\nmovel(a) #K\nmovel(b) #K')],
    "parameter shadows": [script('def f(a):\nmovel(a) #R\nend\nf(b)\nmovel(a) #K\nmovel(b) #O')],
    "local of one name in a function": [script('def f():\nlocal a=p[0.2,0,0,0,0,0]\nend\nmovel(a) #K')],
    "condition reads": [script('if a[2]>0.2:\nmovel(a) #O\nend')],
    "condition over two lines": [script('if (b[2]>0.2 and\n b[1]<2):\nmovel(a) #K\nend\nmovel(b) #O')],
    "alias, other tool": [script('c=a\nmovel(c) #K\nset_tcp(p[0,0,0.3,0,0,0])\nmovel(a) #O')],
    "tool set at the end of the loop": [script('while True:\nmovel(a) #R\nset_tcp(p[0,0,0.3,0,0,0])\nmovel(b) #K\nend')],
    "tool set by a function": [script('def f():\nset_tcp(p[0,0,0.3,0,0,0])\nend\nmovel(a) #K\nf()\nmovel(b) #K')],
    "tool computed": [script('movel(a) #R','set_tcp(get_tcp_offset())\n')],
    "no tool": [script('movel(a) #R\nmovej([0,1,0,1,0,1]) #K','')],
    "feature": [script('movel(pose_trans(b,a)) #K')],
    "feature is moved to as well": [script('movel(pose_trans(b,a)) #K\nmovel(b) #O')],
    "feature at run time": [script('f=get_actual_tcp_pose()\nmovel(pose_trans(f,a)) #R\nmovel(a) #O')],
    "conveyor": [script('track_conveyor_linear(p[1,0,0,0,0,0],500) #R\nmovel(a) #R')],
    "pose_trans defined by the program": ['def pose_trans(x,y):\nreturn y\nend\n'+script('movel(pose_trans(b,a)) #R')],
    "movel defined by the program": ['def movel(x):\nmovej([0,0,0,0,0,0]) #R\nend\n'+script('movel(a) #R')],
    "named inner functions twice": [script('def f():\ndef c():\nmovel(a) #K\nend\nc()\nend\ndef g():\ndef c():\nmovel(b) #K\nend\nc()\nend\nf()\ng()')],
    "list and loop": [script('l=[p[0.4,0,0.3,0,3,0],p[0.5,0,0.3,0,3,0]]\ni=0\nwhile i<2:\nmovel(l[i]) #K\ni=i+1\nend')],
    "list extended": [script('l=[p[0.4,0,0.3,0,3,0]]\nl.append(a)\nmovel(l[0]) #R\nmovel(a) #O')],
    "joints read": [script('q=[0,1,0,1,0,1]\nmovej(q) #O\nx=get_forward_kin(q)')],
    "qnear and move": [script('q=[0,1,0,1,0,1]\nmovej(q) #K\nmovej(get_inverse_kin(a,q)) #K')],
    "force": [script('force_mode(p[0,0,0,0,0,0],[0,0,1,0,0,0],[0,0,1,0,0,0],2,[1,1,1,1,1,1]) #R\nmovel(a) #K')],
    "solved with another tool": [script('movej(get_inverse_kin(a,tcp=p[0,0,0.5,0,0,0])) #K\nmovel(b) #K')],
    "one point, two solved tools": [script('movej(get_inverse_kin(a,tcp=p[0,0,0.5,0,0,0])) #K\nmovel(a) #O')],
    "text sent": [script('socket_send_string("movel(a)")\nmovel(a) #K')],
    "condition sets the tool": [script('def f():\nset_tcp(p[0,0,0.3,0,0,0])\nreturn True\nend\nif f():\nx=1\nelse:\nmovel(a) #K\nend')],
    "loop condition sets the tool": [script('def f():\nset_tcp(p[0,0,0.3,0,0,0])\nreturn True\nend\nwhile f():\nmovel(a) #K\nend\nmovel(b) #K')],
    "else of a loop body": [script('while True:\nif x:\nset_tcp(p[0,0,0.3,0,0,0])\nelse:\nmovel(a) #R\nend\nend')],
    "assigned once, in a branch": [script('if x:\nc=p[0.3,0,0.3,0,3,0]\nend\nmovel(c) #K')],
}  # fmt: skip
ACTIVE = "BAS(#TOOL,1)\nBAS(#BASE,2)\n"
KRL = {
    "inline form": krl("FDAT_ACT=FP1\nBAS(#PTP_PARAMS,100)\nPTP XP1 ;K\nFDAT_ACT=FP1\nBAS(#CP_PARAMS,2)\nLIN XP2 C_DIS ;K"),
    "joints": krl("PTP XHOME ;K\nPTP {A1 0,A2 -90,A3 90,A4 0,A5 0,A6 0} ;K\nPTP {A1 5} ;R"),
    "no frames": krl("PTP XP1 ;R"),
    "frames behind a branch": krl(f"{ACTIVE}IF x THEN\nPTP XP1 ;R\nENDIF"),
    "frames behind a call": krl(f"{ACTIVE}other()\nPTP XP1 ;R"),
    "fixed tool": krl("FDAT_ACT={TOOL_NO 1,BASE_NO 2,IPO_FRAME #TCP}\nLIN XP1 ;R"),
    "tool of a program": krl("$TOOL={X 0,Y 0,Z 50,A 0,B 0,C 0}\n$BASE=$NULLFRAME\nLIN {X 400,Y 0,Z 300,A 0,B 90,C 0} ;K"),
    "tool changed in part": krl(f"{ACTIVE}$TOOL.Z=5\nLIN XP1 ;R"),
    "tool data assigned": krl(f"TOOL_DATA[1].Z=200\n{ACTIVE}LIN XP1 ;R"),
    "tool data assigned twice": krl(f"TOOL_DATA[1]={{X 1,Y 0,Z 0,A 0,B 0,C 0}}\n{ACTIVE}LIN XP1 ;R"),
    "relative": krl(f"{ACTIVE}LIN_REL {{X 5}} ;R\nLIN XP1 ;K"),
    "displaced": krl(f"{ACTIVE}LIN XP1:{{X 0,Y 0,Z 50,A 0,B 0,C 0}} ;R\nLIN XP2 ;K"),
    "component assigned": krl(f"{ACTIVE}XP1.Z=5\nLIN XP1 ;R\nLIN XP2 ;K"),
    "component read": krl(f"{ACTIVE}z=XP1.Z\nLIN XP1 ;R\nLIN XP2 ;K"),
    "given to a routine": krl(f"move(XP1)\n{ACTIVE}LIN XP1 ;R\nLIN XP2 ;K"),
    "two tools": krl(f"{ACTIVE}LIN XP1 ;R\nBAS(#TOOL,0)\nLIN XP1 ;R"),
    "external axis": krl(f"{ACTIVE}LIN {{X 400,Y 0,Z 300,A 0,B 90,C 0,E1 100}} ;R"),
    "not all components": krl(f"{ACTIVE}LIN {{Z 300}} ;R"),
    "a point as a number": krl(f"{ACTIVE}LIN {{X 400,Y .,Z 300,A 0,B 90,C 0}} ;R"),
    "circle": krl(f"{ACTIVE}CIRC XP1,XP2,CA 90 ;K"),
    "data of another module": krl(f"{ACTIVE}LIN XP1 ;K") | {"q.dat": KRL_POINTS, "q.src": f"DEF q()\n{ACTIVE}LIN XP1 ;K\nXP2.X=1\nEND\n"},
    "parameter": {"p.src": f"DEF p(XP1:IN)\n{ACTIVE}LIN XP1 ;R\nEND\n", "p.dat": KRL_POINTS, "$config.dat": FRAMES},
}  # fmt: skip
LS = {
    "plain": ls("J P[1] 100% FINE !K\nL P[2:a] 100mm/sec CNT50 !K"),
    "register": ls("J PR[1] 100% FINE !R\nL P[1] 100mm/sec FINE !K"),
    "offset": ls("L P[1] 100mm/sec FINE Offset,PR[1] !R\nL P[2] 100mm/sec FINE Tool_Offset,PR[2] !R\nL P[3] 100mm/sec FINE !K"),
    "used otherwise": ls("PR[1]=P[1]\nL P[1] 100mm/sec FINE !R\nL P[2] 100mm/sec FINE !K"),
    "assigned": ls("P[1]=LPOS\nL P[1] 100mm/sec FINE !R"),
    "assigned by a number": ls("P[R[1]]=LPOS\nL P[1] 100mm/sec FINE !R"),
    "with and without offset": ls("L P[1] 100mm/sec FINE Offset,PR[1] !R\nL P[1] 100mm/sec FINE !R"),
    "frame set": ls("UFRAME[1]=PR[1]\nL P[1] 100mm/sec FINE !R"),
    "circle": ls("C P[1] P[2] 100mm/sec FINE !K"),
    "coordinated": ls("L P[1] 100mm/sec FINE COORD !R"),
    "computed": ls("L P[1] 100mm/sec FINE !R\nL P[R[1]] 100mm/sec FINE !R\nL P[9] 100mm/sec FINE !R"),
    "another tool": ls("L P[1] 100mm/sec FINE !R", LS_POINTS.replace("UT : 1", "UT : 2")),
    "external axis": ls("L P[1] 100mm/sec FINE !R", LS_POINTS.replace("R =   0.0 deg", "R =   0.0 deg,\n\tE1=  5.0  mm")),
}  # fmt: skip
ALL = {"rapid": RAPID, "urscript": URSCRIPT, "krl": KRL, "ls": LS}
STRANGE_RAPID = {
    "read in a trap": [module('MoveL v1,~ !O\nMoveL v2,~ !K','',"TRAP tr\nVAR robtarget v2;\nv2:=CRobT();\nIF v1.trans.z>5 Stop;\nENDTRAP\n")],
    "joints of a point": [module('jt:=CalcJointT(p1,t1\\WObj:=wobj0);\nMoveAbsJ jt,v1,z1,t1; !R\nMoveL p1,~ !O','VAR jointtarget jt;\n')],
    "distance of points": [module('x:=Distance(p1.trans,v2.trans);\nMoveL p1,~ !O\nMoveL v2,~ !O\nMoveL p3,~ !K')],
    "other case": [module('V1.TRANS.X:=5;\nMOVEL v1,~ !R\nmovel P1,V100,Z1,T1\\wobj:=WOBJ0; !K')],
    "array given to a routine": [module('go a;\nMoveL a{1},~ !O','CONST robtarget a{2}:=['+target(301,2)+','+target(3,4)+'];\n','PROC go(robtarget r{*})\nMoveL r{1},~ !R\nENDPROC\n')],
    "tool of an array": [module('MoveL p1,v1,z1,tools{2}; !K\nMoveL p2,v1,z1,tools{i}; !R','PERS tooldata tools{2}:=[[TRUE,[[0,0,100],[1,0,0,0]],[1,[0,0,1],[1,0,0,0],0,0,0]],[TRUE,[[0,0,200],[1,0,0,0]],[1,[0,0,1],[1,0,0,0],0,0,0]]];\n')],
    "record": [module('s.spot.trans.z:=s.spot.trans.z+4;\nMoveL s.spot,~ !R','VAR stop s:=['+target(1,2)+',0.5];\n').replace('MODULE m\n','MODULE m\nRECORD stop\nrobtarget spot;\nnum wait;\nENDRECORD\n')],
    "quotes in text": [module('TPWrite "say ""v1:=0;"" C:\\\\";\nMoveL v1,~ !K ! "v1:=p2;\nTPWrite "!";v2:=CRobT();\nMoveL v2,~ !R')],
    "continued with a comment": [module('MoveL\\Conc,\np1, ! v1:=p2; "\nv100\\V:=50,z1\\Z:=2\\Inpos:=inpos50,\nt1\\WObj:=wobj0\\TLoad:=load1; !K\nMoveL v1,~ !K')],
    "CRLF, BOM and Latin-1": ['\xef\xbb\xbf! Gr\xf6\xdfe "\r\n'+module('TPWrite "\xb0 \xe4";\nMoveL\tp1,~ !K').replace('\n','\r\n')],
    "conveyor": [module('WaitWObj wc;\nMoveL p1,v1,z1,t1\\WObj:=wc; !R\nMoveL p1,~ !O','PERS wobjdata wc:=[FALSE,FALSE,"CNV1",[[0,0,0],[1,0,0,0]],[[0,0,0],[1,0,0,0]]];\n')],
    "tools of two tasks": [module('MoveL p1,v1,z1,tq; !K','TASK PERS tooldata tq:=[TRUE,[[0,0,100],[1,0,0,0]],[1,[0,0,1],[1,0,0,0],0,0,0]];\n'), OTHER_TASK, module('MoveL p1,v1,z1,tq; !K\ntr:=t1;','TASK PERS tooldata tq:=[TRUE,[[0,0,150],[1,0,0,0]],[1,[0,0,1],[1,0,0,0],0,0,0]];\n')],
    "local routine of the same name": [module('change v1;\nMoveL v1,~ !R','','LOCAL PROC change(robtarget r)\nENDPROC\n'),'MODULE b\nVAR robtarget w:='+target(7)+';\nPROC change(INOUT robtarget r)\nr.trans.x:=0;\nENDPROC\nPROC y()\nchange w;\nMoveL w,v1,z1,t1; !R\nENDPROC\nENDMODULE\n'],
    "alias that is read": [module('MoveL v9,~ !O\nMoveL p1,~ !O\nx:=v9.trans.x;','VAR robtarget v9:=p1;\n')],
    "point read in another task": [module('MoveL q,~ !O','PERS robtarget q:='+target(8)+';\n'), OTHER_TASK, 'MODULE o\nPERS robtarget q:='+target(8)+';\nPROC x()\ny:=q.trans.x;\nENDPROC\nENDMODULE\n'],
    "point with another tool in another task": [module('MoveL q,~ !O','PERS robtarget q:='+target(8)+';\n'), OTHER_TASK, module('MoveL q,v1,z1,t2; !O','PERS robtarget q:='+target(8)+';\n')],
    "Offs of the program": [module('MoveL Offs(p1,0,0,5),~ !R','','FUNC robtarget Offs(robtarget r,num x,num y,num z)\nRETURN p2;\nENDFUNC\n')],
    "INOUT of a function": [module('x:=own(v1);\nMoveL v1,~ !R','','FUNC num own(INOUT robtarget b)\nb:=p1;\nRETURN 1;\nENDFUNC\n')],
    "optional INOUT": [module('own\\b:=v1;\nMoveL v1,~ !R','','PROC own(\\switch a|INOUT robtarget b)\nb:=p1;\nENDPROC\n')],
    "number by value": [module('own h;\nMoveL Offs(p1,0,0,h),~ !K','VAR num h:=3;\n','PROC own(num k)\nk:=k+1;\nENDPROC\n')],
    "two statements in a line": [module('v1:=CRobT(); MoveL p2,~ !K\nMoveL v1,~ !R')],
    "INOUT of an INOUT": [module('outer v1;\nMoveL v1,~ !R','','PROC outer(INOUT robtarget r)\ninner r;\nENDPROC\nPROC inner(INOUT robtarget s)\ns:=CRobT();\nENDPROC\n')],
    "PERS parameter": [module('own q;\nMoveL q,~ !R','PERS robtarget q:='+target(8)+';\n','PROC own(PERS robtarget r)\nr.rot:=p1.rot;\nENDPROC\n')],
    "number counted by Add": [module('Add h,5;\nMoveL RelTool(p1,0,0,h),~ !R\nMoveL RelTool(p2,0,0,-k),~ !K','VAR num h:=10;\nCONST num k:=10;\n')],
    "number of the routine": [module('VAR num h:=10;\nMoveL Offs(p1,0,0,h),~ !K','VAR num h:=3;\n','PROC z()\nh:=h+1;\nENDPROC\n')],
    "tool from the system": [module('GetSysData t1;\nMoveL p1,~ !R')],
    "tool read": [module('x:=t1.tframe.trans.z;\nv3:=CRobT(\\Tool:=t1\\WObj:=wobj0);\nMoveL p1,~ !K')],
    "star": [module('MoveL *,~ !R\nMoveL p1,~ !K')],
    "text to a value": [module('ok:=StrToVal("[]",v1);\nMoveL v1,~ !R\nMoveL v2,~ !O\ns:=ValToStr(v2);')],
    "initial value of a name": [module('MoveL v9,~ !K\nMoveL p1,~ !K','VAR robtarget v9:=p1;\n')],
    "process moves": [module('MoveLDO p1,v1,z1,t1,do1,1; !K\nMoveLSync p2,v1,z1,t1,"v1"; !K\nTriggL p3,v1,tr1,z1,t1; !K')],
    "displaced in a trap of another module": [module('MoveL p1,~ !R'),'MODULE b\nTRAP tr\nPDispOn\\ExeP:=p1,p2,tool0;\nENDTRAP\nENDMODULE\n'],
    "displacement read and taken back": [module('PDispOff;\nMoveL p1,~ !K')],
    "work object of another task": [module('MoveL p1,v1,z1,t1\\WObj:=ws; !R','PERS wobjdata ws:=[FALSE,TRUE,"",[[1,0,0],[1,0,0,0]],[[0,0,0],[1,0,0,0]]];\n'), OTHER_TASK, 'MODULE o\nPERS wobjdata ws:=[FALSE,TRUE,"",[[1,0,0],[1,0,0,0]],[[0,0,0],[1,0,0,0]]];\nPROC x()\nvision ws;\nENDPROC\nENDMODULE\n'],
}  # fmt: skip
STRANGE_URSCRIPT = {
    "tool of a thread": [script('thread t():\nmovel(a) #R\nend\nrun t()\nset_tcp(p[0,0,0.2,0,0,0])\nmovel(b) #K')],
    "element of a local": [script('def f():\nlocal a=p[0.2,0,0,0,0,0]\na[2]=0.5\nend\nf()\nmovel(a) #R')],
    "element in a function": [script('def f():\na[2]=0.5\nend\nmovel(a) #R\nmovel(b) #K')],
    "named tool": [script('movel(a) #K','t=p[0,0,0.2,0,0,0]\nset_tcp(t, "TCP_1")\n')],
    "named tool that is changed": [script('t[2]=0.1\nset_tcp(t)\nmovel(a) #R','t=p[0,0,0.2,0,0,0]\nset_tcp(t)\n')],
    "keyword named as a point": [script('movel(b, a=1.2, v=0.25) #K\nmovec(a, b, a=1.2, v=0.25, r=0, mode=1) #K')],
    "signs in texts": [script('textmsg("# movel(b), a=0")\npopup(\'say "a[2]=1" #\', title="\'")\n$ 3 "movel(a)" "breakAfter"\nmovel(a) #K')],
    "solved joints changed": [script('q=get_inverse_kin(a)\nq[5]=q[5]+1\nmovej(q) #R\nmovel(a) #O')],
    "solved joints": [script('q=get_inverse_kin(a)\nmovej(q) #K\nmovel(a) #K')],
    "between points": [script('movel(interpolate_pose(a,b,0.5)) #R\nmovel(a) #O\nmovel(b) #O')],
    "asked for a solution": [script('if get_inverse_kin_has_solution(a):\nmovel(a) #O\nend')],
    "offset of the path": [script('path_offset_enable() #R\npath_offset_set(p[0,0,0.1,0,0,0],1) #R\nmovel(a) #R')],
    "list of names": [script('l=[a,b]\nmovel(l[0]) #K\nmovel(a) #K\nmovel(b) #O')],
    "list by another name": [script('l=[a,b]\nd=l\nmovel(d[0]) #K\nmovel(a) #K')],
    "list by another name, read": [script('l=[a,b]\nd=l\nmovel(l[1]) #O\nx=d[i]\nmovel(a) #O')],
    "solved joints in a branch": [script('q=get_inverse_kin(a)\nif x:\nq=get_inverse_kin(b)\nend\nmovej(q) #K\nmovel(a) #K')],
    "measured list": [script('l=[a,b]\nwhile i<length(l):\nmovel(l[i]) #K\ni=i+1\nend')],
    "list and its number": [script('l=[a,b]\nsize=2\nf(size,l)\nmovel(l[0]) #O')],
    "list of names, read": [script('l=[a,b]\nmovel(l[0]) #O\nx=l[i]\nif x[0]>0.4:\nsync()\nend\nmovel(a) #O')],
    "list of names, passed on": [script('l=[a,b]\nmovel(l[0]) #O\nf(l)\nmovel(a) #O')],
    "alias that is read": [script('c=a\nmovel(c) #O\nmovel(a) #O\nx=c[0]')],
    "alias of an alias that is read": [script('c=a\nd=c\nmovel(c) #O\nmovel(a) #O\nx=d[0]')],
    "tool that is moved to": [script('movel(a) #O\nset_tcp(a)')],
    "tool of a list": [script('movel(a) #R','l=[p[0,0,0.1,0,0,0],p[0,0,0.2,0,0,0]]\nset_tcp(l[i])\n')],
    "tool set by a program of its own": ['sec s():\nset_tcp(p[0,0,0.3,0,0,0])\nend\n'+script('movel(a) #R')],
    "set_tcp of the program": [script('def set_tcp(x):\nreturn 0\nend\nset_tcp(p[0,0,0.9,0,0,0])\nmovel(a) #R')],
    "CRLF and tabs": [script('\tif True:\n\t\tmovel( a , r = 0 ) #K\n\tend').replace('\n','\r\n')],
    "returned": [script('def f():\nreturn a\nend\nmovel(f()) #R\nmovel(a) #O')],
    "feature changed": [script('f=p[0.1,0,0,0,0,0]\nf[2]=0.1\nmovel(pose_trans(f,a)) #R')],
    "computed number": [script('movel(p[0.4,0.1+0.1,0.3,0,3.1,0]) #R\nmovel(p[0.4,-.1,3e-1,0,3.1,0]) #K')],
    "frame by name": [script('movel(convert_pose(a,"f","base")) #R\nmovel(b) #K')],
    "tool in one branch of two": [script('if x:\nset_tcp(p[0,0,0.3,0,0,0])\nmovel(a) #K\nelif y:\nmovel(b) #K\nend\nmovel(p[0.4,0,0.3,0,3,0]) #R')],
    "nothing is assigned": [script('q=\nmovel(q) #R\nmovel(a) #K')],
    "else of a loop that may not run": [script('while x:\nset_tcp(p[0,0,0.3,0,0,0])\nelse:\nset_tcp(p[0,0,0.3,0,0,0])\nend\nmovel(a) #R', '')],
    "tool set in both branches": [script('if x:\nset_tcp(p[0,0,0.3,0,0,0])\nelif y:\nset_tcp(p[0,0,0.3,0,0,0])\nelse:\nset_tcp(p[0,0,0.3,0,0,0])\nend\nmovel(a) #K', '')],
    "tool not set in one branch": [script('if x:\nset_tcp(p[0,0,0.3,0,0,0])\nelif y:\nset_tcp(p[0,0,0.3,0,0,0])\nend\nmovel(a) #R', '')],
    "different tools in two branches": [script('if x:\nset_tcp(p[0,0,0.3,0,0,0])\nelse:\nset_tcp(p[0,0,0.2,0,0,0])\nend\nmovel(a) #R', '')],
    "tool set in a loop that runs": [script('while True:\nset_tcp(p[0,0,0.3,0,0,0])\nif x:\nbreak\nend\nend\nmovel(a) #K', '')],
    "left before the tool is set": [script('while True:\nif x:\nbreak\nend\nset_tcp(p[0,0,0.3,0,0,0])\nend\nmovel(a) #R', '')],
    "loop that may end at once": [script('while True and x:\nset_tcp(p[0,0,0.3,0,0,0])\nend\nmovel(a) #R', '')],
    "tool set in a loop that may not run": [script('while x:\nset_tcp(p[0,0,0.3,0,0,0])\nend\nmovel(a) #R')],
    "continue before the tool": [script('set_tcp(p[0,0,0.2,0,0,0])\nwhile True:\nmovel(a) #R\nset_tcp(p[0,0,0.3,0,0,0])\nif x:\ncontinue\nend\nset_tcp(p[0,0,0.2,0,0,0])\nend')],
    "tool set by two calls deep": [script('def f():\nset_tcp(p[0,0,0.3,0,0,0])\nend\ndef g():\nif x:\nf()\nend\nend\ng()\nmovel(a) #R')],
}  # fmt: skip
WITH = "WITH $VEL_AXIS[1]=SVEL_JOINT(100.0), $TOOL=STOOL2(FP1), $BASE=SBASE(FP1.BASE_NO), $IPO_MODE=SIPO_MODE(FP1.IPO_FRAME), $LOAD=SLOAD(FP1.TOOL_NO), $APO=SAPO_PTP(PPDAT1)"
FOLD = ";FOLD LIN P1 Vel=2 m/s CPDAT1 Tool[1]:t Base[2]:b;%{PE}%R 8.3\n"
STRANGE_KRL = {
    "fold": krl(f"{FOLD}$BWDSTART=FALSE\nLDAT_ACT=LCPDAT1\nFDAT_ACT=FP1\nBAS(#CP_PARAMS,2)\nLIN XP1 C_DIS ;K\n;ENDFOLD"),
    "tool within the move": krl(f"{ACTIVE}SLIN XP1 WITH $TOOL={{X 0,Y 0,Z 50,A 0,B 0,C 0}} ;K\nSLIN XP2 ;K"),
    "spline": krl(f"{ACTIVE}SPLINE\nSPL XP1 ;K\nSLIN XP2 ;K\nENDSPLINE"),
    "spline with a tool": krl(f"{ACTIVE}SPLINE WITH $TOOL=TOOL_DATA[1], $BASE=$NULLFRAME\nSPL XP1 ;K\nENDSPLINE\nSLIN XP2 ;K"),
    "spline with an unknown tool": krl(f"{ACTIVE}SPLINE WITH $TOOL=TOOL_DATA[2]\nSPL XP1 ;R\nENDSPLINE\nSLIN XP2 ;K"),
    "inline form of splines": krl(f"SPTP XP1 {WITH} C_SPL ;K\nIF x THEN\nSLIN XP2 {WITH} ;K\nENDIF\nSPTP XHOME {WITH} ;K"),
    "stationary tool of splines": krl(f"SLIN XP1 {WITH} ;R", KRL_POINTS.replace("#BASE", "#TCP")),
    "inline form without its data": krl(f"SLIN XP1 {WITH.replace('FP1', 'FP9')} ;R"),
    "mode of a move before": krl(f"FDAT_ACT={{TOOL_NO 1,BASE_NO 2,IPO_FRAME #TCP}}\nBAS(#PTP_PARAMS,1)\n{ACTIVE}LIN XP1 ;R\n$IPO_MODE=#BASE\nLIN XP2 ;K"),
    "data that are not in force": krl("FDAT_ACT=FP1\nPTP XP1 ;R\nBAS(#FRAMES,0)\nPTP XP2 ;K"),
    "home": krl("$H_POS=XHOME\nPTP XHOME ;K") | {"sps.sub": "DEF sps()\n$H_POS=$H_POS\nEND\n"},
    "home that is read": krl("$H_POS=XHOME\nPTP XHOME ;R\nx=$H_POS.A1"),
    "home by the controller": krl("$H_POS=XHOME\nPTP $H_POS ;K"),
    "where it is": krl(f"PTP $AXIS_ACT\n{ACTIVE}LIN $POS_ACT\nLIN XP1 ;K\nXP2=$POS_ACT\nLIN XP2 ;R"),
    "name of a name": krl(f"{ACTIVE}XN=XP1\nLIN XN ;K\nLIN XP2 ;K", KRL_POINTS + "DECL E6POS XN\n"),
    "name of itself": krl(f"{ACTIVE}XN=XM\nXM=XN\nLIN XN ;R", KRL_POINTS + "DECL E6POS XN,XM\n"),
    "array": krl(f"{ACTIVE}LIN XA[1] ;K\nLIN XA[2] ;K", KRL_ARRAY),
    "element without a value": krl(f"{ACTIVE}LIN XA[4] ;R\nLIN XA[1] ;R", KRL_ARRAY),
    "array by a computed number": krl(f"{ACTIVE}LIN XA[1] ;R\nLIN XA[i] ;R\nLIN XP1 ;K", KRL_ARRAY),
    "element changed": krl(f"{ACTIVE}XA[i].X=5\nLIN XA[1] ;R", KRL_ARRAY),
    "element assigned": krl(f"{ACTIVE}XA[i]=XP1\nLIN XA[1] ;R\nLIN XP1 ;R", KRL_ARRAY),
    "base on a kinematic": krl(f"{ACTIVE}LIN XP1 ;R", config=FRAMES + "MACHINE_FRAME_DAT[2]={MACH_DEF_INDEX 3,PARENT[] \" \"}\n"),
    "base of the world": krl(f"{ACTIVE}LIN XP1 ;K", config=FRAMES + "MACHINE_FRAME_DAT[2]={MACH_DEF_INDEX 0,PARENT[] \"WORLD\"}\n"),
    "base of an external axis": krl(f"{ACTIVE}BAS(#EX_BASE,2)\nLIN XP1 ;R"),
    "offset that BAS adds": krl(f"{ACTIVE}TOOL_CORR_ON=TRUE\nLIN XP1 ;R", config=FRAMES + "BOOL TOOL_CORR_ON=FALSE\n"),
    "offset that BAS would add": krl(f"{ACTIVE}TOOL_CORR_ON=FALSE\nLIN XP1 ;K", config=FRAMES + "BOOL TOOL_CORR_ON=FALSE\n"),
    "base from a sensor": krl(f'{ACTIVE}ok=EKI_GetFrame("c","f",BASE_DATA[2])\nLIN XP1 ;R'),
    "frames of a function": krl(f"{ACTIVE}ok=own()\nLIN XP1 ;R") | {"own.src": "DEFFCT BOOL own()\n$TOOL=$NULLFRAME\nRETURN TRUE\nENDFCT\n"},
    "component passed on": krl(f"own(XP1.X)\n{ACTIVE}LIN XP1 ;R\nLIN XP2 ;K"),
    "name that hides a global one": {"p.src": f"DEF a()\nDECL E6POS XG\nXG=XP1\n{ACTIVE}LIN XG ;R\nEND\nDEF b()\n{ACTIVE}LIN XG ;R\nLIN XP2 ;K\nEND\n", "p.dat": KRL_POINTS, "$config.dat": FRAMES + "DECL GLOBAL E6POS XG={X 400,Y 10,Z 300,A 0,B 90,C 0}\n"},
    "system file": krl(f"{ACTIVE}LIN XP1 ;K") | {"bas.src": "DEF bas(c:IN,r:IN)\n$TOOL=TOOL_DATA[TOOL_NO]\nXP1=$H_POS\nPTP posovertp\nEND\n"},
    "interrupt": {"p.src": f"DEF p()\nINTERRUPT DECL 3 WHEN $IN[1] DO isr()\nINTERRUPT ON 3\n{ACTIVE}LIN XP1 ;R\nLIN XP2 ;R\nEND\nDEF isr()\nXP1.Z=5\n$TOOL=TOOL_DATA[2]\nEND\n", "p.dat": KRL_POINTS, "$config.dat": FRAMES},
    "start of the motion": krl(f"{ACTIVE}BAS(#INITMOV,0)\nLIN XP1 ;R"),
    "interrupt of outside": krl(f"GLOBAL INTERRUPT DECL 3 WHEN $STOPMESS==TRUE DO IR_STOPM()\nINTERRUPT ON 3\n{ACTIVE}LIN XP1 ;K"),
    "root": krl(f"{ACTIVE}$ROBROOT={{X 5,Y 0,Z 0,A 0,B 0,C 0}}\nLIN XP1 ;R"),
    "interrupt that stops": {"p.src": f"DEF p()\nINTERRUPT DECL 3 WHEN $IN[1] DO isr()\nINTERRUPT ON 3\n{ACTIVE}LIN XP1 ;K\nEND\nDEF isr()\nBRAKE\nEND\n", "p.dat": KRL_POINTS, "$config.dat": FRAMES},
    "trigger": {"p.src": f"DEF p()\n{ACTIVE}TRIGGER WHEN DISTANCE=0 DELAY=0 DO isr() PRIO=-1\nLIN XP1 ;R\nLIN XP2 ;R\nEND\nDEF isr()\nBAS(#TOOL,0)\nEND\n", "p.dat": KRL_POINTS, "$config.dat": FRAMES},
    "global of the controller": krl(f"{ACTIVE}LIN XG ;R", config=FRAMES + "DECL GLOBAL E6POS XG={X 400,Y 10,Z 300,A 0,B 90,C 0,S 2,T 2}\n") | {"q.src": "DEF q()\nz=XG.Z\nEND\n"},
    "declared in the program": krl(f"DECL E6POS XP1\n{ACTIVE}XP1=$POS_ACT\nLIN XP1 ;R\nLIN XP2 ;K"),
    "jump over a tool": krl(f"{ACTIVE}GOTO far\nBAS(#TOOL,0)\nfar:\nLIN XP1 ;R"),
    "jump back": krl(f"{ACTIVE}far:\nLIN XP1 ;R\nBAS(#TOOL,0)\nGOTO far"),
    "repeat": krl(f"{ACTIVE}REPEAT\nLIN XP1 ;R\n$TOOL=$NULLFRAME\nUNTIL x"),
    "case": krl(f"{ACTIVE}SWITCH x\nCASE 1\n$BASE=$NULLFRAME\nENDSWITCH\nLIN XP1 ;R"),
    "exit from a loop": krl(f"{ACTIVE}LOOP\nIF x THEN\nEXIT\nENDIF\nBAS(#TOOL,0)\nENDLOOP\nLIN XP1 ;R"),
    "base by a number": krl("BAS(#TOOL,1)\n$BASE=BASE_DATA[i]\nLIN XP1 ;R"),
    "stationary tool": krl(f"{ACTIVE}$IPO_MODE=#TCP\nLIN XP1 ;R"),
    "frame data changed": krl("FP1.TOOL_NO=3\nFDAT_ACT=FP1\nLIN XP1 ;R"),
    "active frame changed": krl("FDAT_ACT=FP1\nFDAT_ACT.TOOL_NO=3\nLIN XP1 ;R"),
    "base changed in part": krl(f"{ACTIVE}$BASE.X=$BASE.X+10\nLIN XP1 ;R"),
    "other case": krl("bas(#tool,1)\nbas(#base,2)\nxp1.z=5\nlin xp1 ;R\nlin xp2 ;K"),
    "text": krl(f'{ACTIVE}MSG[]="XP1.Z=5;"\n;XP1.Z=5 "\nLIN XP1 ;K'),
    "coupled base": krl("BAS(#TOOL,1)\n$BASE=EK(MACHINE_DEF[2].ROOT,MACHINE_DEF[2].MECH_TYPE,{X 0,Y 0,Z 0,A 0,B 0,C 0})\nLIN XP1 ;R"),
    "function": krl(f"{ACTIVE}z=high(XP1)\nLIN XP1 ;R"),
}  # fmt: skip


def raw_ls(body):
    """Return a program of whole lines."""
    return {"p.ls": f"/PROG P\n/MN\n{body}{LS_POINTS}"}


STRANGE_LS = {
    "increment": ls("L P[1] 100mm/sec FINE INC !R\nL P[1] 100mm/sec FINE !R\nL P[2] 100mm/sec FINE !K"),
    "arc": ls("A P[1] 100mm/sec CNT100 !K\nA P[2] 100mm/sec FINE !K"),
    "skip": ls("SKIP CONDITION DI[1]=ON\nL P[1] 100mm/sec FINE Skip,LBL[1] !R\nL P[2] 100mm/sec FINE !K\nJMP LBL[2]\nLBL[1]\nLBL[2]"),
    "remote tool": ls("L P[1] 100mm/sec FINE RTCP !R"),
    "vision": ls("L P[1] 100mm/sec FINE VOFFSET,VR[1] !R\nL P[2] 100mm/sec FINE ACC50 !K"),
    "offset condition": ls("OFFSET CONDITION PR[1]\nL P[1] 100mm/sec FINE Offset !R"),
    "touched": ls("Touch Offset PR[1]\nL P[1] 100mm/sec FINE !R\nTouch Offset End"),
    "tool set": ls("UTOOL[R[1]]=PR[3]\nL P[1] 100mm/sec FINE !R"),
    "tool set in a condition": ls("IF R[1]=1,UTOOL[1]=PR[3]\nL P[1] 100mm/sec FINE !R"),
    "tool read": ls("PR[3]=UTOOL[1]\nL P[1] 100mm/sec FINE !K"),
    "tool of the system": ls("$MNUTOOL[1,1]=PR[1]\nL P[1] 100mm/sec FINE !R"),
    "active tool": ls("UTOOL_NUM=1\nUFRAME_NUM=0\nPAYLOAD[1]\nCALL GRIP(1)\nL P[1] 100mm/sec FINE !K"),
    "remark": ls("!PR[2]=P[2]\n//L P[3] 100mm/sec FINE Offset,PR[1]\nL P[1] 100mm/sec FINE !K"),
    "continued": raw_ls("   1:  L P[1] 100mm/sec FINE\n    :  Tool_Offset,PR[2] !R ;\n   2:  C P[2]\n    :  P[3] 100mm/sec FINE !K ;\n"),
    "line tracking": {"p.ls": ls("L P[1] 100mm/sec FINE !R")["p.ls"].replace("/MN", "/APPL\n  LINE_TRACK;\nLINE_TRACK_SCHEDULE_NUMBER\t: 1;\n/MN")},
    "frame of the moment": ls("L P[1] 100mm/sec FINE !R", LS_POINTS.replace("UF : 0", "UF : F")),
    "second group": ls("L P[1] 100mm/sec FINE !K\nL P[2] 100mm/sec FINE !K", LS_POINTS.replace("R =   0.0 deg\n}", "R =   0.0 deg\n   GP2:\n\tUF : 0, UT : 1,\n\tJ1=     5.0 deg\n}", 1)),
    "two tools": ls("L P[1] 100mm/sec FINE !R\nL P[2] 100mm/sec FINE !K", LS_POINTS.replace("UT : 1", "UT : 3", 1)),
    "register by a number": ls("PR[R[2]]=P[R[1]]\nL P[1] 100mm/sec FINE !R"),
    "palletizing": ls("L PAL_1[BTM] 100mm/sec FINE !R\nL P[1] 100mm/sec FINE !K"),
    "tool set in another program": ls("L P[1] 100mm/sec FINE !R") | {"q.ls": ls("UTOOL[1]=PR[3]\nL P[1] 100mm/sec FINE !R")["p.ls"]},
    "program without points": ls("L P[1] 100mm/sec FINE !K") | {"q.ls": "/PROG Q\n/MN\n   1:  DO[1]=ON ;\n/POS\n/END\n"},
}  # fmt: skip
STRANGE = {"rapid": STRANGE_RAPID, "urscript": STRANGE_URSCRIPT, "krl": STRANGE_KRL, "ls": STRANGE_LS}
GIVEN = {"ut1": frame_of((0.0, 0.0, 0.1, 0.0, 0.0, 0.0))}


def named(files):
    """Return files by name: those of a list have the folders of their tasks."""
    if isinstance(files, dict):
        return files
    other = files.index(OTHER_TASK) if OTHER_TASK in files else len(files)
    return {f"TASK{1 + (k > other)}/f{k}": text for k, text in enumerate(files) if text}


def error(flange):
    """Return the pose of a flange with an error of up to 0.7 mm and 1 mrad."""
    x, y, z = flange[:3, 3]
    moved = frame_of((x + 5e-4 * np.sin(3 * x + 1), y + 4e-4 * np.cos(2 * y), 1.0006 * z, 1e-3 * x, -1e-3 * y, 5e-4))
    moved[:3, :3] = moved[:3, :3] @ flange[:3, :3]
    return moved


def settled(programs):
    """Return the census of each program, corrected by ``error``, and what the goals want."""
    censuses, wanted, joints = [Census(program, True) for program in programs], {}, {}
    for program in programs:
        goals = [goal for move in program.moves if move.reason is None for goal in move.goals]
        posed = [goal for goal in goals if not goal.is_joints]
        for goal, pose in zip(posed, target_poses(posed), strict=True):
            wanted[goal] = inverted(goal.frame) @ error(goal.frame @ pose @ inverted(goal.tool)) @ goal.tool
        for goal in goals:
            if goal.is_joints:
                q = readings_of(goal.target.literal)
                joints[goal] = Joints(q, q + 1e-3)
    for census in censuses:
        census.settle(wanted)
    return censuses, wanted, joints


def check(language, files, **surroundings):
    """Correct files, compare each move with its mark, and read what is written again."""
    texts = {name: text.replace("~", "v100,z1,t1\\WObj:=wobj0;") for name, text in named(files).items()}
    given = Surroundings(**surroundings)

    def read(contents):
        return read_programs(language, [Source(name, data) for name, data in contents.items()], given)

    before = {name: text.encode("latin-1") for name, text in texts.items()}
    programs = read(before)
    censuses, wanted, joints = settled(programs)
    after = {}
    for census in censuses:
        data = changed_files(census.program, changes_of(census, wanted, joints, True))
        after |= dict(zip([source.name for source in census.program.files], data, strict=True))
    again = read(after)
    marks, outcomes = [], []
    for census, program in zip(censuses, again, strict=True):
        assert difference(census.program, program, wanted, joints, True) == ""
        for move in census.program.moves:
            source = census.program.files[move.place.file]
            start, end = source.data.rfind(b"\n", 0, move.place.offset) + 1, source.line_end(move.end)
            marks += MARK.findall(source.data[start:end].decode("latin-1"))
            outcomes.append("R" if move.reason else "O" if move in census.replaced else "K")
    assert outcomes == marks
    assert len(marks) == sum(len(MARK.findall(text)) for text in texts.values())
    if "O" not in marks:
        without = [[NUMBER.sub("#", data.decode("latin-1")) for data in files.values()] for files in (before, after)]
        assert without[0] == without[1]
    assert (after != before) == bool(set(marks) & {"K", "O"})


PROGRAMS = [(language, cases[name]) for kind in (ALL, STRANGE) for language, cases in kind.items() for name in cases]
NAMES = [f"{language}-{name}" for kind in (ALL, STRANGE) for language, cases in kind.items() for name in cases]


@pytest.mark.parametrize(("language", "files"), PROGRAMS, ids=NAMES)
def test_each_move_is_corrected_or_stays(language, files):
    """The strange ones are written from the languages alone, without a look at what reads them."""
    check(language, files, frames=GIVEN)


OUTSIDE = {  # what files that are not there may do: with --strict, and for names that nothing outside changes
    "assumed": (module("other;\nMoveL p1,~ !K"), {}),
    "strict": (module("other;\nMoveL p1,~ !R"), {"strict": True}),
    "strict with a condition": (module("IF a AND (b OR NOT (c)) THEN\nMoveL p1,~ !K\nENDIF"), {"strict": True}),
    "strict without such a routine": (module("MoveL p1,~ !K"), {"strict": True}),
    "passed on": (module("other v1;\nMoveL v1,~ !R"), {}),
    "passed on, unchanged": (module("other v1;\nMoveL v1,~ !O"), {"unchanged": frozenset({"v1"})}),
    "passed on within, unchanged or not": (module("own v1;\nMoveL v1,~ !R", "", "PROC own(INOUT robtarget r)\nr:=p1;\nENDPROC\n"), {"unchanged": frozenset({"v1"})}),
    "axis": (module("MoveL [[1,2,3],[1,0,0,0],[0,0,0,0],[120,9E9,9E9,9E9,9E9,9E9]],~ !K"), {"unchanged": frozenset({"eax_a"})}),
    "given tool": (module("MoveL p1,v1,z1,grip; !K"), {"frames": {"grip": np.eye(4)}}),
    "given tool that is assigned": (module("MoveL p1,v1,z1,grip; !R\ngrip:=t1;"), {"frames": {"grip": np.eye(4)}}),
    "given tool that is passed on": (module("MoveL p1,v1,z1,grip; !R\nother grip;"), {"frames": {"grip": np.eye(4)}}),
}  # fmt: skip


@pytest.mark.parametrize("name", OUTSIDE)
def test_what_other_files_may_change(name):
    text, surroundings = OUTSIDE[name]
    check("rapid", [text], **{"frames": GIVEN, **surroundings})


STRICT = [
    ("urscript", [script("grip()\nmovel(p[0.4,0.1,0.3,0,3.1,0]) #R")]),
    ("krl", krl(f"grip()\n{ACTIVE}LIN XP1 ;R")),
    ("ls", ls("CALL GRIP(1)\nL P[1] 100mm/sec FINE !R")),
    ("ls", ls("CALL Q\nL P[1] 100mm/sec FINE !K") | {"q.ls": "/PROG Q\n/MN\n   1:  DO[1]=ON ;\n/POS\n/END\n"}),
]


@pytest.mark.parametrize(("language", "files"), STRICT)
def test_strict_refuses_poses_that_a_routine_of_no_file_may_displace(language, files):
    check(language, files, frames=GIVEN, strict=True)


BROKEN_KRL = [
    "BAS(", "BAS(#TOOL", "BAS(#TOOL,)", "$TOOL=", "$H_POS=", "FDAT_ACT=", "SPLINE WITH $TOOL", "XP1=", "P[1]=", "=", "(", "GLOBAL", "DEF =", "..a", "/R1/P..XP1=",
    "LIN", "LIN {", "LIN ,", "LIN {X}", "LIN {X 0..0,Y 1,Z 1,A 0,B 0,C 0}", "LIN {X 1 2,Y 1,Z 1,A 0,B 0,C 0}", "LIN {X a1,Y 1,Z 1,A 0,B 0,C 0}", "SLIN WITH",
    "SLIN XP1 WITH $TOOL=STOOL2(", "SLIN XP1 WITH $TOOL=STOOL2(),$BASE=SBASE(FP1.),$IPO_MODE", "DECL E6POS", "DECL FRAME F={X", "TRIGGER DO", "MACHINE_FRAME_DAT[2]=",
]  # fmt: skip


@pytest.mark.parametrize("line", BROKEN_KRL)
def test_a_broken_line_costs_its_move_alone(line):
    files = krl(f"{line}\n{ACTIVE}LIN XP2\nPTP XHOME")
    (program,) = read_programs("krl", [Source(name, text.encode()) for name, text in files.items()], Surroundings())
    assert program.moves[-1].goals
    assert not any(move.goals for move in program.moves[:-2])
