"""Adversarial programs: each move is corrected in its literal (K), gets numbers of its own (O), or is refused (R).

A made-up robot error that changes with the place takes the place of the robot. Whatever is written is read again, and
no byte outside numbers changes unless a move gets numbers of its own.
"""

import re

import numpy as np
import pytest

from truearm.correct.programs.census import Census
from truearm.correct.programs.corrected_text import Joints, changed_files, changes_of
from truearm.correct.programs.languages import read_programs
from truearm.correct.programs.poses import readings_of
from truearm.correct.programs.program import Surroundings
from truearm.correct.programs.reread import difference, target_poses
from truearm.correct.programs.tokens import Source
from truearm.model.poses import frame_of, inverted

NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")
MARK = re.compile(r"[!#;] ?([KOR])\b")
OTHER_TASK = ""  # the files after it are another task's
TOOLS = "MODULE m\nPERS tooldata t1:=[TRUE,[[0,0,100],[1,0,0,0]],[1,[0,0,1],[1,0,0,0],0,0,0]];\nPERS tooldata t2:=[TRUE,[[0,0,200],[1,0,0,0]],[1,[0,0,1],[1,0,0,0],0,0,0]];\n"
WORK = 'PERS wobjdata w1:=[FALSE,TRUE,"",[[100,0,0],[1,0,0,0]],[[0,0,0],[1,0,0,0]]];\n'


def target(x, y=0):
    return f"[[{x},{y},300],[0,0,1,0],[0,0,0,0],[9E9,9E9,9E9,9E9,9E9,9E9]]"


POINTS = "".join(
    f"CONST robtarget p{k}:={target(300 + k, k)};\nVAR robtarget v{k}:={target(400 + k, k)};\n" for k in (1, 2, 3)
)
POINTS += "CONST jointtarget j1:=[[0,10,20,0,30,0],[9E9,9E9,9E9,9E9,9E9,9E9]];\n"


def module(body, data="", routines=""):
    """Return a module whose main has a body; ~ stands for the end of a move with tool t1."""
    return f"{TOOLS}{WORK}{POINTS}{data}PROC main()\n{body}\nENDPROC\n{routines}ENDMODULE\n"


def script(body, head="set_tcp(p[0,0,0.1,0,0,0])\n"):
    """Return a script with the points a and b."""
    return f"def main():\n{head}a=p[0.4,0.1,0.3,0,3.1,0]\nb=p[0.5,-0.1,0.3,0,3.1,0]\n{body}\nend\n"


FRAMES = "TOOL_DATA[1]={X 0,Y 0,Z 100,A 0,B 0,C 0}\nBASE_DATA[2]={X 10,Y 0,Z 0,A 0,B 0,C 0}\n"
KRL_POINTS = 'DEFDAT p\nDECL E6POS XP1={X 400,Y 10,Z 300,A 0,B 90,C 0,S 2,T 2,E1 0.0,E2 0.0}\nDECL E6POS XP2={X 450,Y 20,Z 300,A 0,B 90,C 0,S 2,T 2,E1 0.0}\nDECL FDAT FP1={TOOL_NO 1,BASE_NO 2,IPO_FRAME #BASE,POINT2[] " "}\nDECL E6AXIS XHOME={A1 5,A2 -90,A3 100,A4 5,A5 10,A6 5}\nENDDAT\n'


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
    "PDispSet": [module('MoveL p1,~ !R\nPDispSet d;\nMoveL p2,~ !R')],
    "PDispOn \\Rot": [module('PDispOn\\Rot, p1, t1;\nMoveL p2,~ !R\nMoveAbsJ j1,v1,z1,t1; !K')],
    "tool reassigned in a TRAP": [module('MoveL p1,~ !R','',"TRAP tr\nt1:=t2;\nENDTRAP\n")],
    "tool component assigned in another module": [module('MoveL p1,~ !R'),'MODULE b\nPROC x()\nt1.tframe.trans.z:=150;\nENDPROC\nENDMODULE\n'],
    "tool measured": [module('MToolTCPCalib j1,j1,j1,j1,t1,e,e2; !R\nMoveL p1,~ !R')],
    "TPWrite of the point": [module('MoveL v1,~ !O\nTPWrite "x"\\Pos:=v1.trans;')],
    "TPWrite of text": [module('MoveL v1,~ !K\nTPWrite "v1 := nothing";')],
    "component assigned": [module('v1.trans.x:=5;\nMoveL v1,~ !R')],
    "component read by IF": [module('IF v1.trans.x > 3 THEN\nMoveL v1,~ !O\nENDIF')],
    "compact IF reads": [module('IF p1.trans.x>3 MoveL p2,~ !K\nMoveL p1,~ !O')],
    "compact IF assigns": [module('IF di1=1 v1:=p2;\nMoveL v1,~ !K\nMoveL p2,~ !K')],
    "p := p2": [module('v1:=v2;\nMoveL v2,~ !K\nMoveL v1,~ !K')],
    "array in a loop, one tool": [module('FOR i FROM 1 TO 2 DO\nMoveL a{i},~ !K\nENDFOR','CONST robtarget a{2}:=['+target(1,2)+','+target(3,4)+'];\n')],
    "array in a loop, element assigned": [module('a{2}:=p1;\nFOR i FROM 1 TO 2 DO\nMoveL a{i},~ !R\nENDFOR','VAR robtarget a{2}:=['+target(1,2)+','+target(3,4)+'];\n')],
    "array, two tools": [module('FOR i FROM 1 TO 2 DO\nMoveL a{i},~ !K\nENDFOR\nMoveL a{1},v100,z1,t2; !O','CONST robtarget a{2}:=['+target(301,2)+','+target(3,4)+'];\n')],
    "loop counter named as a point": [module('FOR p1 FROM 1 TO 2 DO\nMoveL p1,~ !R\nENDFOR')],
    "offset counts": [module('FOR i FROM 1 TO 2 DO\nMoveL Offs(p1,0,0,i*10),~ !R\nENDFOR\nMoveL p1,~ !O')],
    "offset constant near": [module('MoveL Offs(p1,0,0,1),~ !K\nMoveL p1,~ !K')],
    "offset constant far": [module('MoveL Offs(p1,0,0,400),~ !O\nMoveL p1,~ !K')],
    "offset by a num that is assigned": [module('MoveL Offs(p1,0,0,h),~ !R\nh:=h+1;','VAR num h:=10;\n')],
    "offset by a num of a constant": [module('MoveL Offs(p1,0,0,-h/2),~ !K','CONST num h:=10;\n')],
    "RelTool with Rz": [module('MoveL RelTool(p1,0,0,5\\Rz:=10),~ !K')],
    "LOCAL shadows": [TOOLS + f'LOCAL CONST robtarget p:={target(1)};\nPROC x()\nMoveL p,~ !K\nENDPROC\nENDMODULE\n',f'MODULE b\nCONST robtarget p:={target(2)};\nPROC y()\nMoveL p,~ !K\nENDPROC\nENDMODULE\n'],
    "routine data shadows": [module('VAR robtarget p1;\np1:=CRobT();\nMoveL p1,~ !R','','PROC z()\nMoveL p1,~ !K\nENDPROC\n')],
    "parameter shadows": [module('z p2;','','PROC z(robtarget p1)\nMoveL p1,~ !R\nENDPROC\nPROC y()\nMoveL p1,~ !K\nMoveL p2,~ !O\nENDPROC\n')],
    "same global name in two modules, used in a third": [module('MoveL q,~ !R'),f'MODULE b\nCONST robtarget q:={target(1)};\nENDMODULE\n',f'MODULE c\nCONST robtarget q:={target(2)};\nENDMODULE\n'],
    "passed by INOUT": [module('change v1;\nMoveL v1,~ !R','','PROC change(INOUT robtarget r)\nr.trans.z:=0;\nENDPROC\n')],
    "passed to an unknown routine": [module('change v1;\nMoveL v1,~ !R')],
    "tool passed to an unknown routine": [module('Grip t1;\nMoveL p1,~ !R')],
    "SearchL stores into v1": [module('SearchL di1,v1,p2,v100,t1; !K\nMoveL v1,~ !R')],
    "SetDataVal by name": [module('SetDataVal "v1",v2;\nMoveL v1,~ !R\nMoveL p1,v100,z1,tool0; !K')],
    "late bound call with argument": [module('%"x"% v1;\nMoveL v1,~ !R')],
    "held work object": [module('MoveL p1,v1,z1,t1\\WObj:=wh; !R\nMoveL p1,~ !O','PERS wobjdata wh:=[TRUE,TRUE,"",[[0,0,0],[1,0,0,0]],[[0,0,0],[1,0,0,0]]];\n')],
    "stationary tool": [module('MoveL p1,v1,z1,ts; !R','PERS tooldata ts:=[FALSE,[[0,0,0],[1,0,0,0]],[1,[0,0,1],[1,0,0,0],0,0,0]];\n')],
    "work object on a mechanical unit": [module('MoveL p1,v1,z1,t1\\WObj:=wm; !R','PERS wobjdata wm:=[FALSE,FALSE,"STN1",[[0,0,0],[1,0,0,0]],[[0,0,0],[1,0,0,0]]];\n')],
    "work object computed": [module('w1.oframe:=DefFrame(p1,p2,p3);\nMoveL v1,v1,z1,t1\\WObj:=w1; !R\nMoveL p1,~ !O')],
    "external axis": [module('MoveL x1,~ !R','CONST robtarget x1:=[[1,2,3],[1,0,0,0],[0,0,0,0],[120,9E9,9E9,9E9,9E9,9E9]];\n')],
    "SingArea LockAxis4": [module('SingArea\\LockAxis4;\nMoveL p1,~ !R')],
    "Corr": [module('MoveL p1,v1,z1,t1\\Corr; !R')],
    "comment and text": [module('! v1 := p2;\nTPWrite "MoveL p1; v1:=0;";\nMoveL v1,~ !K')],
    "two tools, one point": [module('MoveL p1,v1,z1,t1; !K\nMoveL p1,v1,z1,t2; !O')],
    "declared in terms of names": [module('MoveL n1,~ !R','CONST num x0:=5;\nCONST robtarget n1:=[[x0,0,0],[1,0,0,0],[0,0,0,0],[9E9,9E9,9E9,9E9,9E9,9E9]];\n')],
    "RETURN of the point by a function": [module('MoveL f(),~ !R\nMoveL p1,~ !O','','FUNC robtarget f()\nRETURN p1;\nENDFUNC\n')],
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
    "p := p2, p2 := p": [module('v1:=v2;\nv2:=v1;\nMoveL v1,~ !R')],
    "p := p2 then read": [module('v1:=v2;\nMoveL v1,~ !R\nx:=v1.trans;')],
    "tool := other": [module('t1:=t2;\nMoveL p1,~ !R')],
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
    "length by point_dist": [script('x=point_dist(a,b)\nmovel(a) #O')],
    "alias": [script('c=a\nmovel(c) #K\nmovel(a) #K')],
    "alias, other tool": [script('c=a\nmovel(c) #K\nset_tcp(p[0,0,0.3,0,0,0])\nmovel(a) #O')],
    "tool in a branch": [script('if x:\nset_tcp(p[0,0,0.3,0,0,0])\nend\nmovel(a) #R')],
    "tool set twice": [script('movel(a) #K\nset_tcp(p[0,0,0.3,0,0,0])\nmovel(b) #K')],
    "tool set at the end of the loop": [script('while True:\nmovel(a) #R\nset_tcp(p[0,0,0.3,0,0,0])\nmovel(b) #K\nend')],
    "tool set by a function": [script('def f():\nset_tcp(p[0,0,0.3,0,0,0])\nend\nmovel(a) #K\nf()\nmovel(b) #K')],
    "function called with two tools": [script('def f():\nmovel(a) #R\nend\nf()\nset_tcp(p[0,0,0.3,0,0,0])\nf()')],
    "tool set in a thread": [script('thread t():\nset_tcp(p[0,0,0.3,0,0,0])\nend\nrun t()\nmovel(a) #R')],
    "tool computed": [script('movel(a) #R','set_tcp(get_tcp_offset())\n')],
    "no tool": [script('movel(a) #R\nmovej([0,1,0,1,0,1]) #K','')],
    "feature": [script('movel(pose_trans(b,a)) #K')],
    "feature is moved to as well": [script('movel(pose_trans(b,a)) #K\nmovel(b) #O')],
    "feature at run time": [script('f=get_actual_tcp_pose()\nmovel(pose_trans(f,a)) #R\nmovel(a) #O')],
    "counts": [script('i=0\nwhile i<3:\nmovel(pose_add(a,p[0,0,0.1*i,0,0,0])) #R\ni=i+1\nend\nmovel(a) #O')],
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
    "value sent": [script('socket_send_string(a)\nmovel(a) #O')],
    "pose_sub of two points": [script('movel(pose_sub(a,b)) #K\nmovel(b) #O')],
    "condition sets the tool": [script('def f():\nset_tcp(p[0,0,0.3,0,0,0])\nreturn True\nend\nif f():\nx=1\nelse:\nmovel(a) #K\nend')],
    "loop condition sets the tool": [script('def f():\nset_tcp(p[0,0,0.3,0,0,0])\nreturn True\nend\nwhile f():\nmovel(a) #K\nend\nmovel(b) #K')],
    "else of a loop body": [script('while True:\nif x:\nset_tcp(p[0,0,0.3,0,0,0])\nelse:\nmovel(a) #R\nend\nend')],
    "assigned once, in a branch": [script('if x:\nc=p[0.3,0,0.3,0,3,0]\nend\nmovel(c) #K')],
}  # fmt: skip
ACTIVE = "BAS(#TOOL,1)\nBAS(#BASE,2)\n"
KRL = {
    "inline form": krl("FDAT_ACT=FP1\nPTP XP1 ;K\nFDAT_ACT=FP1\nLIN XP2 C_DIS ;K"),
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
    "computed": ls("L P[R[1]] 100mm/sec FINE !R\nL P[9] 100mm/sec FINE !R"),
    "another tool": ls("L P[1] 100mm/sec FINE !R", LS_POINTS.replace("UT : 1", "UT : 2")),
    "external axis": ls("L P[1] 100mm/sec FINE !R", LS_POINTS.replace("R =   0.0 deg", "R =   0.0 deg,\n\tE1=  5.0  mm")),
}  # fmt: skip
ALL = {"rapid": RAPID, "urscript": URSCRIPT, "krl": KRL, "ls": LS}
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
    moved = frame_of(
        (x + 0.5e-3 * np.sin(3 * x + 1), y + 0.4e-3 * np.cos(2 * y), z * (1 + 0.6e-3), 1e-3 * x, -1e-3 * y, 5e-4)
    )
    moved[:3, :3] = moved[:3, :3] @ flange[:3, :3]
    return moved


def settled(programs):
    """Return the census of each program, corrected by ``error``, and what the goals want."""
    censuses, wanted, joints = [Census(program, True) for program in programs], {}, {}
    for program in programs:
        goals = [goal for move in program.moves if move.reason is None for goal in move.goals]
        posed = [goal for goal in goals if not goal.target.literal.form.is_joints]
        for goal, pose in zip(posed, target_poses(posed), strict=True):
            wanted[goal] = inverted(goal.frame) @ error(goal.frame @ pose @ inverted(goal.tool)) @ goal.tool
        for goal in goals:
            if goal.target.literal.form.is_joints:
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
            outcomes.append("R" if move.reason else "O" if move in census.own else "K")
    assert outcomes == marks
    assert len(marks) == sum(len(MARK.findall(text)) for text in texts.values())
    if "O" not in marks:
        assert {name: NUMBER.sub("#", data.decode("latin-1")) for name, data in after.items()} == {
            name: NUMBER.sub("#", text) for name, text in texts.items()
        }
    assert (after != before) == bool(set(marks) & {"K", "O"})


@pytest.mark.parametrize(("language", "name"), [(language, name) for language, cases in ALL.items() for name in cases])
def test_each_move_is_corrected_or_stays(language, name):
    check(language, ALL[language][name], frames=GIVEN)


OUTSIDE = {  # what files that are not there may do: with --strict, and for names that nothing outside changes
    "assumed": (module("other;\nMoveL p1,~ !K"), {}),
    "strict": (module("other;\nMoveL p1,~ !R"), {"strict": True}),
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
