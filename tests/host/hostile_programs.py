"""Programs of one megabyte of one thing each, which a reader may be slow at.

A kind is what stands before, what is repeated (``{k}`` is a count from 1, ``{r}`` a number that looks random), and what stands after.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import count
from typing import NamedTuple

MEGABYTE = 2**20
P = "p[0.4,-0.2,0.3,2.2,-2.2,0.1]"
Q = "[0.1,-1.2,1.3,-0.4,1.5,0.2]"
T = "[[400,-200,300],[0,0,1,0],[0,0,0,0],[9E9,9E9,9E9,9E9,9E9,9E9]]"
J = "[[1,2,3,4,5,6],[9E9,9E9,9E9,9E9,9E9,9E9]]"
WOBJ = '[FALSE,TRUE,"",[[1,2,{k}],[1,0,0,0]],[[0,0,0],[1,0,0,0]]]'
TOOL = "[TRUE,[[1,2,{k}],[1,0,0,0]],[1,[0,0,1],[1,0,0,0],0,0,0]]"


class Kind(NamedTuple):
    """A program of one thing: what is before, what is repeated, and what is after."""

    before: str
    unit: str
    after: str = ""

    def text(self, size: int = MEGABYTE) -> bytes:
        """Return the program of a size, in bytes."""
        room = size - len(self.before) - len(self.after)
        if "{k}" not in self.unit and "{r}" not in self.unit:
            middle = self.unit * max(room // len(self.unit), 1)
        else:
            parts, left = [], room
            for k in count(1):
                part = self.unit.replace("{k}", str(k)).replace("{r}", str(k * 7919 % 10007))
                left -= len(part)
                if left < 0:
                    break
                parts.append(part)
            middle = "".join(parts)
        return f"{self.before}{middle}{self.after}".encode("latin-1")


_EXPRESSIONS: Mapping[str, str] = {
    # a piece that is repeated within one expression
    "open round": "(", "closed round": "()", "open square": "[", "empty lists": "[],", "list in list": "[1,", "minus": "-", "not": "not ", "plus": "1+",
    "and": "a and ", "or": "x or ", "dots": "a.", "fields": "a.b+", "many numbers": "1,", "long number": "1", "names": "a{k},", "same name": "a,",
    "calls in calls": "f(", "calls": "f(),", "calls of numbers": "f({k}),", "texts": '"a",', "texts added": '"ab"+', "names added": "a{k}+", "points": "1.5,", "exponents": "1e3,", "signs": "-1,",
    "bad exponents": "1e,", "two points": "1..2,", "comparisons": "a<b and ", "truths": "True,",
}  # fmt: skip


def _urscript() -> dict[str, Kind]:
    expressions = {
        "expression: " + name: Kind("def main():\nx=f(", unit, "1)\nend\n") for name, unit in _EXPRESSIONS.items()
    }
    expressions |= {
        "index: " + name: Kind("def main():\na=[1,2]\nx=", unit, "0\nend\n")
        for name, unit in {"index": "a[", "index of index": "a[0][1]+", "row": "a[0,1]+", "item": "a[0]+"}.items()
    }
    raw = {
        "raw: " + repr(unit): Kind("", unit)
        for unit in (
            "(", "[", "p[", " ", "\n", "\r", "\r\n", "a", "1", "%", '"', "'", "!", "#", "$", ".", "=", "\t", "\xef\xbb\xbf", "\xe4", "p", "0.", "1e", "[1,", "a.", "a[", "not ",
            "def f():\n", "if a:\n", "while a:\n", "thread t():\n", "sec s():\n", "else:\n", "end\n", "# comment\n", "$ 1 \"MoveJ\"\n", "\"a\"\n", "\"a", "[0,0,0,0,0,", "p[0,0,0,0,0,", "[0,0,0,0,0,0",
            "p[0 , 0 , 0 , 0 , 0 ", "halt\n", "return\n", "break\n", "continue\n", "a=", "global a=1\n", "local a\n", "join t\n", "run t\n", ",", ":", ")", "]", "a()", "a(\n", "+", "\f",
        )
    }  # fmt: skip
    lines = {
        "movel": f"movel({P})\n",
        "movel short": "movel(p[0,0,0,0,0,0])\n",
        "movej": f"movej({Q})\n",
        "movej short": "movej([0,0,0,0,0,0])\n",
        "movel each": "movel(p[0.{k},0.1,0.2,0,3,0],a=1.2,v=0.25,r=0.01)\n",
        "movej each": "movej([0.{k},0.1,0.2,0,3,0],a=1.2,v=0.25,r=0.01)\n",
        "movec": f"movec({P},{P})\n",
        "movec each": "movec(p[0.{k},0.1,0.2,0,3,0],p[0.{r},0,0,0,0,0])\n",
        "named move": "movel(pose=p[0.{k},0,0,0,0,0])\n",
        "solved": "movej(get_inverse_kin(p[0.{k},0,0,0,0,0]))\n",
        "solved near": "movej(get_inverse_kin(p[0.{k},0,0,0,0,0],qnear=[0,0,0,0,0,0]))\n",
        "solved near computed": "movej(get_inverse_kin(p[0.{k},0,0,0,0,0],qnear=[0,0,0,0,0,d2r(90)]))\n",
        "pose_trans": "movel(pose_trans(p[0,0,0,0,0,0],p[0.{k},0,0,0,0,0]))\n",
        "pose_add": "movel(pose_add(p[0,0,0,0,0,0],p[0.{k},0,0,0,0,0]))\n",
        "pose_sub": "movel(pose_sub(p[0,0,0,0,0,0],p[0.{k},0,0,0,0,0]))\n",
        "pose_inv": "movel(pose_inv(p[0.{k},0,0,0,0,0]))\n",
        "pose_trans alone": "pose_trans(p[0,0,0,0,0,0],p[0,0,0,0,0,0])\n",
        "pose_add alone": "x=pose_add(p[0,0,0,0,0,0],p[0,0,0,0,0,0])\n",
        "pose_trans nested": "x=pose_trans(pose_trans(p[0,0,0,0,0,0],p[0,0,0,0,0,0]),p[0,0,0,0,0,0])\n",
        "poses of expressions": "movel(p[0.1*{k},0,0,0,0,0])\n",
        "poses of names": "movel(p[x,0,0,0,0,0])\n",
        "joints of expressions": "movej([d2r({k}),0,0,0,0,0])\n",
        "d2r": "x=d2r(1)\n",
        "rpy2rotvec": "x=rpy2rotvec([0,0,{k}])\n",
        "rotvec2rpy": "x=rotvec2rpy([0,0,1])\n",
        "set_tcp": "set_tcp(p[0,0,0.{k},0,0,0])\n",
        "set_tcp same": "set_tcp(p[0,0,0,0,0,0])\n",
        "set_tcp and move": "set_tcp(p[0,0,0.{k},0,0,0])\nmovel(p[0.{r},0,0,0,0,0])\n",
        "set_tcp expressions": "set_tcp(p[0,0,0.1*{k},0,0,0])\n",
        "struct": "s{k}=struct(a=1,b=2)\n",
        "struct moves": "s{k}=struct(a=p[0,0,0,0,0,{k}])\nmovel(s{k}.a)\n",
        "struct fields changed": "s.a={k}\n",
        "lists": "l{k}=[1,2,3]\n",
        "lists same": "l=[1,2,3]\n",
        "item changed": "l[0]={k}\n",
        "item read": "x=l[0]\n",
        "items of joints": "x=j[0]\n",
        "items of poses": "x=w[0]\n",
        "item of pose changed": "w[0]={k}\n",
        "item of joints changed": "j[0]={k}\n",
        "item by unknown": "x=l[u]\n",
        "item changed by unknown": "l[u]={k}\n",
        "assign": "a{k}=1\n",
        "assign short": "a=1\n",
        "assign pose": "a{k}=p[0,0,0,0,0,{k}]\n",
        "assign pose same": "a=p[0,0,0,0,0,{k}]\n",
        "assign and move": "a{k}=p[0,0,0,0,0,{k}]\nmovel(a{k})\n",
        "assign and move same": "a=p[0,0,0,0,0,{k}]\nmovel(a)\n",
        "assign name": "a{k}=b{r}\n",
        "count up": "a=a+1\n",
        "count up list": "l=[l]\n",
        "global": "global a{k}=1\n",
        "local": "local a{k}=1\n",
        "declare": "local a{k}\n",
        "if": "if a:\nb=1\nend\n",
        "if each": "if a:\nb{k}=1\nend\n",
        "if else": "if a:\nb=1\nelse:\nb=2\nend\n",
        "if else each": "if a:\nb={k}\nelse:\nb={r}\nend\n",
        "if moves": "if a:\nmovel(p[0,0,0,0,0,{k}])\nend\n",
        "if tool": "if a:\nset_tcp(p[0,0,0,0,0,{k}])\nend\nmovel(p[0,0,0,0,0,{r}])\n",
        "if pose": "if a:\nb=p[0,0,0,0,0,{k}]\nend\n",
        "if pose move": "if a:\nb=p[0,0,0,0,0,{k}]\nend\nmovel(b)\n",
        "if calls": "if f():\nb=1\nend\n",
        "if halt": "if a:\nhalt\nend\n",
        "if return": "if a:\nreturn 1\nend\n",
        "if empty": "if a:\nend\n",
        "if short": "if a:b=1 end\n",
        "if short moves": "if a: movel(w) end\n",
        "while": "while a:\nb=1\nend\n",
        "while each": "while a:\nb{k}=1\nend\n",
        "while counts": "while a:\nb=b+1\nend\n",
        "while moves": "while a:\nmovel(p[0,0,0,0,0,{k}])\nend\n",
        "while break": "while a:\nbreak\nend\n",
        "while empty": "while a:\nend\n",
        "while pose": "while a:\nb=pose_trans(b,p[0,0,0.1,0,0,0])\nend\n",
        "comments": "# a comment {k}\n",
        "comment after": "a=1 # comment\n",
        "markers": '$ {k} "MoveJ"\n',
        "spaces": "    \n",
        "texts": 'textmsg("a")\n',
        "texts joined": 't=str_cat(t,"abc")\n',
        "texts sent": 'socket_send_line("abc")\n',
        "texts sent moves": 'socket_send_line("movel(p[0,0,0,0,0,0])")\n',
        "unknown calls": "q{k}()\n",
        "unknown call": "q()\n",
        "unknown call with arguments": "q(a,b,{k})\n",
        "unknown moves": "movel(z{k})\n",
        "aimless": "speedl([0,0,0,0,0,0],1,1)\n",
        "no target": "movel()\n",
        "quiet": "sync()\n",
        "sleep": "sleep(0.1)\n",
        "methods": "x.a()\n",
        "threads run": "run t()\n",
        "joins": "join t\n",
        "calls": "f()\n",
        "calls with number": "g({k})\n",
        "calls with pose": "h(p[0,0,0,0,0,{k}])\n",
        "calls with same pose": "h(p[0,0,0,0,0,0])\n",
        "calls in calls": "g(g(g(1)))\n",
        "make_list": "x=make_list(1000,1)\n",
        "actual": "x=get_actual_tcp_pose()\n",
        "not": "x=not a\n",
        "and": "x=a and b\n",
        "servoj": "servoj([0,0,0,0,0,{k}],t=0.002)\n",
        "payload": "set_payload(1,[0,0,0])\n",
        "digital out": "set_digital_out(1,True)\n",
        "conveyor": "track_conveyor_linear(p[0,0,0,0,0,0],{k})\n",
        "expressions": "x=1+2*3-4/5\n",
        "expressions of names": "x=a+b*c-d/e\n",
        "long move": "movel(p[0.1234567890123456789{k},0.12345678901234567890,0.1234567890123456789,0,3,0])\n",
    }
    setting = (
        "def f():\nsleep(1)\nend\ndef g(x):\nreturn x\nend\ndef h(x):\nmovel(x)\nend\nthread t():\nsleep(1)\nend\n"
        f'def main():\na=1\nb=2\nc=3\nd=4\ne=5\nt=""\nl=[1,2,3]\nj=[0,0,0,0,0,0]\nw=p[0,0,0,0,0,0]\ns=struct(a=1)\nu=get_digital_in(1)\nmovel({P})\n'
    )
    found = {**expressions, **raw, **{name: Kind(setting, unit, "end\n") for name, unit in lines.items()}}
    found |= {
        "many procs": Kind("", "def f{k}():\nend\n", f"movel({P})\n"),
        "many procs with moves": Kind("", "def f{k}():\nmovel(p[0,0,0,0,0,{k}])\nend\n", "f1()\n"),
        "many procs calling": Kind("def f0():\nend\n", "def f{k}():\nf{r}()\nend\n", f"movel({P})\n"),
        "many procs calling first": Kind("def f0():\nend\n", "def f{k}():\nf0()\nend\n", f"movel({P})\n"),
        "many procs assigning": Kind("", "def f{k}():\nglobal a=1\nend\n", f"movel({P})\n"),
        "many threads": Kind("", "thread t{k}():\na=1\nend\n", f"movel({P})\n"),
        "many threads run": Kind("", "thread t{k}():\nend\nrun t{k}()\n", f"movel({P})\n"),
        "many threads moving": Kind("", "thread t{k}():\nmovel(p[0,0,0,0,0,{k}])\nend\nrun t{k}()\n"),
        "many parameters": Kind("def f(", "a{k},", "b):\nend\nmovel(p[0,0,0,0,0,0])\n"),
        "many defaults": Kind("def f(", "a{k}=1,", "b=1):\nend\nf()\nmovel(p[0,0,0,0,0,0])\n"),
        "many arguments": Kind("def f(x):\nend\nf(", "1,", "1)\nmovel(p[0,0,0,0,0,0])\n"),
        "many poses in a list": Kind("l=[", "p[0,0,0,0,0,{k}],", "p[0,0,0,0,0,0]]\nmovel(l[0])\n"),
        "many poses chosen": Kind("u=get_digital_in(0)\nl=[", "p[0,0,0,0,0,{k}],", "p[0,0,0,0,0,0]]\nmovel(l[u])\n"),
        "many poses in a loop": Kind("l=[", "p[0,0,0,0,0,{k}],", "p[0,0,0,0,0,0]]\ni=0\nwhile i<9:\nmovel(l[i])\ni=i+1\nend\n"),
        "many lists in a list": Kind("l=[", "[1],", "[1]]\nmovel(p[0,0,0,0,0,0])\n"),
        "many fields": Kind("s=struct(", "a{k}=1,", "b=1)\nmovel(p[0,0,0,0,0,0])\n"),
        "fields assigned": Kind(
            f"s=struct({','.join(f'a{i}=0' for i in range(500))})\nmovel(p[0,0,0,0,0,0])\n", "s.a7={k}\n"
        ),
        "many elifs": Kind("if a:\nb=1\n", "elif a:\nb=1\n", "end\nmovel(p[0,0,0,0,0,0])\n"),
        "many elifs each": Kind("if a:\nb=1\n", "elif a=={k}:\nb={k}\n", "end\nmovel(p[0,0,0,0,0,0])\n"),
        "many elifs with poses": Kind("if a:\nb=1\n", "elif a:\nb=p[0,0,0,0,0,{k}]\n", "end\nmovel(b)\n"),
        "many elifs with calls": Kind("def f():\nend\nif a:\nb=1\n", "elif f():\nb=1\n", "end\nmovel(p[0,0,0,0,0,0])\n"),
        "many elifs with moves": Kind("if a:\nb=1\n", "elif a:\nmovel(p[0,0,0,0,0,{k}])\n", "end\n"),
        "many breaks": Kind("while a:\n", "if a:\nbreak\nend\n", "end\nmovel(p[0,0,0,0,0,0])\n"),
        "many breaks with values": Kind("while a:\n", "x=p[0,0,0,0,0,{k}]\nif a:\nbreak\nend\n", "end\nmovel(x)\n"),
        "many moves in a loop": Kind("def main():\nwhile True:\n", "movel(p[0.{k},0,0,0,0,0])\n", "end\nend\n"),
        "many returns": Kind("def f(a):\n", "if a:\nreturn {k}\nend\n", "end\nx=f(1)\nmovel(p[0,0,0,0,0,0])\n"),
        "many values in a loop": Kind("while a:\n", "x{k}=x{r}\n", "end\nmovel(p[0,0,0,0,0,0])\n"),
        "if nest short": Kind(f"movel({P})\n", "if a:\n" * 50 + "b={k}\n" + "end\n" * 50),
        "if nest pose": Kind(f"movel({P})\n", "if a:\n" * 50 + "b=p[0,0,0,0,0,{k}]\n" + "end\n" * 50, "movel(b)\n"),
        "if else nest": Kind(f"movel({P})\n", "if a:\nc={k}\nelse:\n" * 50 + "b={k}\n" + "end\n" * 50),
        "while nest": Kind(f"movel({P})\n", "while a:\n" * 10 + "b=b+1\n" + "end\n" * 10),
        "while nest pose": Kind(f"movel({P})\n", "while a:\n" * 5 + "b=pose_add(b,p[0,0,0,0,0,{k}])\n" + "end\n" * 5),
        "def nest": Kind(f"movel({P})\n", "".join(f"def f{i}_{{k}}():\n" for i in range(50)) + "end\n" * 50),
        "deep lists": Kind(f"movel({P})\n", "x=" + "[" * 50 + "1" + "]" * 50 + "\n"),
        "deep lists moves": Kind("", "movel(" + "[" * 45 + "1" + "]" * 45 + ")\n"),
        "deep brackets": Kind(f"movel({P})\n", "x=" + "(" * 50 + "1" + ")" * 50 + "\n"),
        "deep not": Kind(f"movel({P})\n", "x=" + "not " * 50 + "a\n"),
        "deep minus": Kind(f"movel({P})\n", "x=" + "-" * 50 + "a\n"),
        "deep calls": Kind(f"movel({P})\n", "x=" + "sin(" * 50 + "1" + ")" * 50 + "\n"),
        "deep pose_inv": Kind("", "movel(" + "pose_inv(" * 50 + "p[0,0,0,0,0,{k}]" + ")" * 50 + ")\n"),
        "deep pose_trans": Kind("", "movel(" + "pose_trans(p[0,0,0,0,0,0]," * 45 + "p[0,0,0,0,0,{k}]" + ")" * 45 + ")\n"),
        "deep pose_add": Kind("", "movel(" + "pose_add(" * 45 + "p[0,0,0,0,0,{k}]" + ",p[0,0,0,0,0,0])" * 45 + ")\n"),
        "long chains": Kind(f"movel({P})\n", "x=1" + "+a" * 900 + "\n"),
        "long fields": Kind(f"movel({P})\n", "x=a" + ".b" * 900 + "\n"),
        "long indexes": Kind(f"movel({P})\n", "x=a" + "[0]" * 900 + "\n"),
        "long comparisons": Kind(f"movel({P})\n", "x=1" + "<a" * 900 + "\n"),
        "ors": Kind(f"movel({P})\n", "x=f(1)" + " or f(1)" * 20 + "\n", "def f(x):\nreturn x\nend\n"),
        "fields moves": Kind("", "movel(s" + ".a" * 20 + ")\n"),
        "fields moves known": Kind("s=struct(a=p[0,0,0,0,0,1])\n", "movel(s.a)\n"),
        "numbers of targets added": Kind(f"x=0\nmovel({P})\n", "x=x+get_pose(p[0,0,0,0,0,{k}])[2]*p[0,0,0,0,1,{k}][2]\n"),
        "offsets from targets": Kind(f"x=0\nw={P}\n", "v=p[0,0,0.3,0,0,0.{k}]\nx=x+v[2]\nmovel(pose_add(w,p[0,0,x,0,0,0]))\n"),
        "decisions by targets": Kind(f"w={P}\n", "if w[2]>0.{k}:\nmovel(w)\nend\n"),
        "lists compared": Kind(f"l=[{','.join([P] * 300)}]\nm=l\ny=l==m\nmovel({P})\n", "if y:\nx=y\nelse:\nx={k}\nend\n"),
        "growing list": Kind("l=[1]\n", "l=[l,l]\n", f"movel({P})\n"),
        "growing product": Kind("w=p[0,0,0,0,0,1]\n", "w=pose_trans(w,w)\n", "movel(w)\n"),
        "growing product by one": Kind("w=p[0,0,0,0,0,1]\n", "w=pose_trans(w,p[0,0,0,0,0,{k}])\n", "movel(w)\n"),
        "growing product moves": Kind("w=p[0,0,0,0,0,1]\n", "w=pose_trans(w,p[0,0,0,0,0,{k}])\nmovel(w)\n"),
        "growing choices": Kind("w=1\n", "if a:\nw={k}\nend\n", "x=w+w\nmovel(p[0,0,0,0,0,0])\n"),
        "growing choices moves": Kind("w=p[0,0,0,0,0,1]\n", "if a:\nw=p[0,0,0,0,0,{k}]\nend\nmovel(w)\n"),
        "growing tools moves": Kind("", "if a:\nset_tcp(p[0,0,0,0,0,{k}])\nend\nmovel(p[0,0,0,0,0,1])\n"),
        "calls of calls": Kind("def f0():\nmovel(p[0,0,0,0,0,0])\nend\n", "def f{k}():\nf0()\nf0()\nend\nf{k}()\n"),
        "call tree": Kind(
            "def g0(x):\nmovel(x)\nend\n" + "".join(f"def g{i}(x):\ng{i-1}(pose_trans(x,p[0,0,0,0,0,1]))\ng{i-1}(pose_trans(x,p[0,0,0,0,0,2]))\nend\n" for i in range(1, 15)),
            "g14(p[0,0,0,0,0,{k}])\n",
        ),
        "calls with text": Kind("def f(x):\nmovel(p[0,0,0,0,0,0])\nend\n", 'f("{k}")\n'),
        "calls setting global": Kind("def f():\nglobal b=p[0,0,0,0,0,0]\nend\n", "f()\nmovel(b)\n"),
        "calls with global pose": Kind("def f():\nmovel(b)\nend\n", "global b=p[0,0,0,0,0,{k}]\nf()\n"),
        "one long comment": Kind("#", "a", f"\nmovel({P})\n"),
        "one long text": Kind('textmsg("', "a", f'")\nmovel({P})\n'),
        "one long name": Kind("", "a", f"=1\nmovel({P})\n"),
        "one long line of moves": Kind("x=[", "movel(p[0,0,0,0,0,{k}]),", "1]\n"),
        "one unterminated text": Kind(f"movel({P})\ntextmsg(\"", "a b ", "\n"),
        "unterminated texts": Kind(f"movel({P})\n", 'textmsg("a\n'),
        "text with moves": Kind('socket_send_line("', "movel (", f'")\nmovel({P})\n'),
        "text nearly with moves": Kind('socket_send_line("', "movel ", f'")\nmovel({P})\n'),
        "text of blanks": Kind('socket_send_line("movel', " ", f'")\nmovel({P})\n'),
        "spaces in a pose": Kind("movel(p[0,0,0,0,0,0", " ", "])\n"),
        "spaces before a move": Kind("", " ", f"movel({P})\n"),
        "long numbers": Kind("movel(p[0,0,0,0,0,0.", "1", "])\n"),
        "newlines in brackets": Kind("movel(", "\n", f"{P})\n"),
        "newlines in lists": Kind("x=[", "1,\n", f"1]\nmovel({P})\n"),
        "CAM moves": Kind("def main():\nset_tcp(p[0,0,0.1,0,0,0])\n", "movel(p[0.{k},-0.{r},0.123456,2.221441,-2.221441,0.000001],a=1.200000,v=0.250000,r=0.001000)\n", "end\n"),
        "CAM moves near": Kind("def main():\nset_tcp(p[0,0,0.1,0,0,0])\n", "movej(get_inverse_kin(p[0.{k},-0.{r},0.123456,2.221441,-2.221441,0.000001],qnear=[0.1,-1.2,1.3,-0.4,1.5,0.2]),a=1.2,v=0.25)\n", "end\n"),
    }  # fmt: skip
    return found


def _rapid() -> dict[str, Kind]:
    head = (
        "MODULE m\nPERS tooldata t1:=" + TOOL.replace("{k}", "3") + ";\nPERS wobjdata w1:=" + WOBJ.replace("{k}", "3") + ";\n"
        f"CONST robtarget p1:={T};\nCONST jointtarget j1:={J};\nVAR num a;\nVAR num b:=1;\nVAR bool c;\nVAR robtarget v1:={T};\nVAR num l{{3}}:=[1,2,3];\n"
        "PROC f()\nWaitTime 1;\nENDPROC\nPROC g(num x)\nENDPROC\nPROC h(robtarget x)\nMoveL x,v10,fine,tool0;\nENDPROC\nPROC i(INOUT num x)\nx:=1;\nENDPROC\nFUNC num k(num x)\nRETURN x;\nENDFUNC\n"
        "PROC main()\nMoveL p1,v10,fine,tool0;\n"
    )  # fmt: skip
    tail = "ENDPROC\nENDMODULE\n"
    expressions = {
        "expression: " + name: Kind(head + "a:=k(", unit, "1);\n" + tail) for name, unit in _EXPRESSIONS.items()
    }
    expressions |= {
        "index: " + name: Kind(head + "a:=", unit, "1;\n" + tail)
        for name, unit in {"index": "l{", "item": "l{1}+", "row": "l{1,2}+", "field": "p1.trans.x+"}.items()
    }
    raw = {
        "raw: " + repr(unit): Kind("", unit)
        for unit in (
            "(", "[", " ", "\n", "\r\n", "a", "1", "%", '"', "'", "!", "#", "\\", ".", ":=", ";", "\t", "\xef\xbb\xbf", "\xe4", "0x", "1e", "[1,", "a.", "a{", "NOT ", "%%%", "%%%\n", '""', "MODULE m\n",
            "MODULE m\nENDMODULE\n", "PROC f()\n", "! comment\n", "[[0,0,0],", "[[0,0,0],[1,0,0,0],", "[[0,0,0],[1,0,0,0],[0,0,0,0],", "[[ 0 , 0 , 0 ], ", "[ ", "\"a\"", "\"a\n", "<SMT>", "<", "VAR num a;\n",
        )
    }  # fmt: skip
    raw |= {
        "module: " + repr(unit): Kind("MODULE m\n", unit)
        for unit in (
            "(", "[", " ", "a", "1", "%", '"', ";", "VAR num a;\n", "VAR num a{{k}}:=1;\n".replace("{{k}}", "{k}"), "PROC f{k}()\n", "RECORD r{k}\nnum a;\nENDRECORD\n", "RECORD r\n", "num a;\n", "ALIAS num n{k};\n", "LOCAL ", "! a\n", "CONST num a:=", "PROC f(num a,",
            "IF a THEN\n", "%%%\nVERSION:1\n%%%\n",
        )
    }  # fmt: skip
    lines = {
        "MoveL": f"MoveL {T},v10,fine,tool0;\n",
        "MoveL each": "MoveL [[{k},2,3],[1,0,0,0],[0,0,0,0],[9E9,9E9,9E9,9E9,9E9,9E9]],v10,fine,tool0;\n",
        "MoveJ each": "MoveJ [[{k},2,3],[1,0,0,0],[0,0,0,0],[9E9,9E9,9E9,9E9,9E9,9E9]],v10,fine,tool0;\n",
        "MoveL name": "MoveL p1,v10,fine,tool0;\n",
        "MoveL name tool": "MoveL p1,v10,fine,t1\\WObj:=w1;\n",
        "MoveL star": "MoveL *,v10,fine,tool0;\n",
        "MoveAbsJ": f"MoveAbsJ {J},v10,fine,tool0;\n",
        "MoveAbsJ each": "MoveAbsJ [[{k},2,3,4,5,6],[9E9,9E9,9E9,9E9,9E9,9E9]],v10,fine,tool0;\n",
        "MoveAbsJ name": "MoveAbsJ j1,v10,fine,tool0;\n",
        "MoveC": "MoveC p1,p1,v10,fine,tool0;\n",
        "MoveC offs": "MoveC Offs(p1,{k},0,0),Offs(p1,0,{k},0),v10,fine,tool0;\n",
        "Offs": "MoveL Offs(p1,{k},0,0),v10,fine,tool0;\n",
        "Offs same": "MoveL Offs(p1,1,0,0),v10,fine,tool0;\n",
        "Offs alone": "a:=Offs(p1,1,0,0);\n",
        "Offs nested": "v1:=Offs(Offs(Offs(p1,1,0,0),1,0,0),1,0,0);\n",
        "Offs grows": "v1:=Offs(v1,1,0,0);\n",
        "RelTool": "MoveL RelTool(p1,{k},0,0),v10,fine,tool0;\n",
        "RelTool turned": "MoveL RelTool(p1,0,0,0\\Rx:={k}),v10,fine,tool0;\n",
        "RelTool alone": "v1:=RelTool(p1,0,0,0\\Rz:=3);\n",
        "OrientZYX": "v1.rot:=OrientZYX(1,2,{k});\n",
        "offsets from targets": "n:=n+p1.trans.z;\nMoveL Offs(p1,0,0,n),v10,fine,tool0;\n",
        "fields moves": "v1.trans.x:={k};\nMoveL v1,v10,fine,tool0;\n",
        "fields": "v1.trans.x:={k};\n",
        "fields same": "v1.trans.x:=1;\n",
        "fields read": "a:=v1.trans.x;\n",
        "fields read const": "a:=p1.trans.x;\n",
        "fields of fields": "a:=v1.trans.x+v1.trans.y+v1.trans.z;\n",
        "fields joints": "a:=j1.robax.rax_1;\n",
        "fields counted": "v1.trans.x:=v1.trans.x+1;\n",
        "array item": "l{1}:={k};\n",
        "array item read": "a:=l{1};\n",
        "array item by unknown": "a:=l{a};\n",
        "array item changed by unknown": "l{a}:={k};\n",
        "assign": "b:=1;\n",
        "assign each": "x{k}:=1;\n",
        "assign target": "v1:=[[{k},2,3],[1,0,0,0],[0,0,0,0],[9E9,9E9,9E9,9E9,9E9,9E9]];\n",
        "assign target move": "v1:=[[{k},2,3],[1,0,0,0],[0,0,0,0],[9E9,9E9,9E9,9E9,9E9,9E9]];\nMoveL v1,v10,fine,tool0;\n",
        "assign target name": "v1:=p1;\n",
        "count up": "b:=b+1;\n",
        "list in list": "v1:=[v1];\n",
        "if": "IF c THEN\nb:=1;\nENDIF\n",
        "if short": "IF c b:=1;\n",
        "if short each": "IF c b:={k};\n",
        "if short moves": "IF c MoveL p1,v10,fine,tool0;\n",
        "if else": "IF c THEN\nb:=1;\nELSE\nb:={k};\nENDIF\n",
        "if moves": "IF c THEN\nMoveL Offs(p1,{k},0,0),v10,fine,tool0;\nENDIF\n",
        "if target": "IF c THEN\nv1:=[[{k},2,3],[1,0,0,0],[0,0,0,0],[9E9,9E9,9E9,9E9,9E9,9E9]];\nENDIF\n",
        "if target move": "IF c v1:=Offs(p1,{k},0,0);\nMoveL v1,v10,fine,tool0;\n",
        "if calls": "IF k(1)=1 THEN\nb:=1;\nENDIF\n",
        "if empty": "IF c THEN\nENDIF\n",
        "if exit": "IF c EXIT;\n",
        "if return": "IF c RETURN;\n",
        "if nest one line": "IF c " * 40 + "b:=1;\n",
        "wobj if": "IF c w1.uframe.trans.x:={k};\nMoveL p1,v10,fine,tool0\\WObj:=w1;\n",
        "tool if": "IF c t1.tframe.trans.x:={k};\nMoveL p1,v10,fine,t1;\n",
        "wobj": "w1.uframe.trans.x:={k};\nMoveL p1,v10,fine,tool0\\WObj:=w1;\n",
        "tool": "t1.tframe.trans.x:={k};\nMoveL p1,v10,fine,t1;\n",
        "wobj alone": "w1.uframe.trans.x:={k};\n",
        "wobj whole": "w1:=" + WOBJ + ";\n",
        "tool whole": "t1:=" + TOOL + ";\n",
        "tool whole move": "t1:=" + TOOL + ";\nMoveL p1,v10,fine,t1;\n",
        "for": "FOR n FROM 1 TO 3 DO\nb:=1;\nENDFOR\n",
        "for moves": "FOR n FROM 1 TO 3 DO\nMoveL Offs(p1,{k},0,0),v10,fine,tool0;\nENDFOR\n",
        "for counted moves": "FOR n FROM 1 TO 3 DO\nMoveL Offs(p1,n,0,0),v10,fine,tool0;\nENDFOR\n",
        "for empty": "FOR n FROM 1 TO 3 DO\nENDFOR\n",
        "while": "WHILE c DO\nb:=b+1;\nENDWHILE\n",
        "while empty": "WHILE c DO\nENDWHILE\n",
        "while target": "WHILE c DO\nv1:=Offs(v1,1,0,0);\nENDWHILE\n",
        "test": "TEST a\nCASE 1:\nb:=1;\nDEFAULT:\nb:=2;\nENDTEST\n",
        "test empty": "TEST a\nENDTEST\n",
        "test numbers": "TEST a\nCASE 1,2,3,4,5,6,7,8,9:\nENDTEST\n",
        "calls": "f;\n",
        "calls number": "g {k};\n",
        "calls same number": "g 1;\n",
        "calls target": "h Offs(p1,{k},0,0);\n",
        "calls same target": "h p1;\n",
        "calls inout": "i b;\n",
        "calls function": "a:=k({k});\n",
        "calls function nested": "a:=k(k(k(1)));\n",
        "unknown procs": "u{k};\n",
        "unknown proc": "u;\n",
        "unknown procs with arguments": "u{k} p1,v1,b;\n",
        "unknown procs with target": "u v1;\nMoveL v1,v10,fine,tool0;\n",
        "unknown function": "a:=u(1);\n",
        "unknown functions": "a:=u{k}(1);\n",
        "unknown targets": "MoveL u{k},v10,fine,tool0;\n",
        "unknown tools": "MoveL p1,v10,fine,u{k};\n",
        "unknown wobjs": "MoveL p1,v10,fine,tool0\\WObj:=u{k};\n",
        "late bound": '%"f"%;\n',
        "by name": 'CallByVar "f",1;\n',
        "labels": "a{k}:\n",
        "gotos": "GOTO a;\n",
        "quiet": "SetDO d1,1;\n",
        "quiet args": "TPWrite \"a\"\\Num:=b;\n",
        "waits": "WaitTime 0.5;\n",
        "aimless": "EGMRunPose e,1;\n",
        "searches": "SearchL d1,v1,p1,v10,tool0;\n",
        "searches other": "SearchL d1,x{k},p1,v10,tool0;\n",
        "arcs": "ArcL p1,v10,s,w,fine,tool0;\n",
        "triggers": "TriggL p1,v10,t,fine,tool0;\n",
        "displaced": "PDispOn p1,t1;\n",
        "displaced set": "PDispSet x;\nMoveL p1,v10,fine,tool0;\nPDispOff;\n",
        "confl": "ConfL\\Off;\nMoveL p1,v10,fine,tool0;\nConfL\\On;\n",
        "confl if": "IF c ConfL\\Off;\nMoveL Offs(p1,{k},0,0),v10,fine,tool0;\n",
        "singarea": "SingArea\\Wrist;\n",
        "singarea lock": "SingArea\\LockAxis4;\nMoveL p1,v10,fine,tool0;\n",
        "returns": "RETURN;\n",
        "exits": "EXIT;\n",
        "raises": "RAISE;\n",
        "connects": "CONNECT a WITH f;\n",
        "comments": "! comment {k}\n",
        "comment after": "b:=1; ! comment\n",
        "blanks": "   \n",
        "smt": "<SMT>\n",
        "semicolons": "f;f;f;\n",
        "switches": "f\\a\\b\\c;\n",
        "switch values": "f\\a:=1\\b:=2;\n",
        "passed": "f\\a?a;\n",
        "named": "g x:=1;\n",
        "texts": 'TPWrite "abc";\n',
        "texts added": 'TPWrite "abc"+"def";\n',
        "texts sent": 'SocketSend s\\Str:="abc";\n',
        "texts sent moves": 'SocketSend s\\Str:="MoveL p1";\n',
        "CJointT": "MoveAbsJ CJointT(),v10,fine,tool0;\n",
        "CRobT": "v1:=CRobT();\n",
        "CRobT moves": "MoveL Offs(CRobT(),{k},0,0),v10,fine,tool0;\n",
        "numbers": "b:=1+2*3-4/5;\n",
        "names": "b:=a+b*a-b/a;\n",
        "hex": "b:=0xFF;\n",
        "and": "c:=c AND c;\n",
        "not": "c:=NOT c;\n",
        "quoted text": 'TPWrite "a""b""c";\n',
        "spaced target": "MoveL [ [ {k} , 2 , 3 ] , [ 1 , 0 , 0 , 0 ] , [ 0 , 0 , 0 , 0 ] , [ 9E9 , 9E9 , 9E9 , 9E9 , 9E9 , 9E9 ] ],v10,fine,tool0;\n",
        "expression target": "MoveL [[{k}+1,2,3],[1,0,0,0],[0,0,0,0],[9E9,9E9,9E9,9E9,9E9,9E9]],v10,fine,tool0;\n",
        "expression target named": "MoveL [p1.trans,p1.rot,p1.robconf,p1.extax],v10,fine,tool0;\n",
        "expression joints": "MoveAbsJ [[{k}+1,2,3,4,5,6],[9E9,9E9,9E9,9E9,9E9,9E9]],v10,fine,tool0;\n",
        "external axes": "MoveL [[{k},2,3],[1,0,0,0],[0,0,0,0],[1,9E9,9E9,9E9,9E9,9E9]],v10,fine,tool0;\n",
        "MoveExtJ": "MoveExtJ j1,v10,fine;\n",
        "missing arguments": "MoveL p1;\n",
        "missing all": "MoveL;\n",
    }  # fmt: skip
    data = {
        "num": "VAR num n{k}:=1;\n",
        "num without value": "VAR num n{k};\n",
        "pers num": "PERS num n{k}:=1;\n",
        "const num": "CONST num n{k}:=1;\n",
        "robtargets": "CONST robtarget q{k}:=[[{k},2,3],[1,0,0,0],[0,0,0,0],[9E9,9E9,9E9,9E9,9E9,9E9]];\n",
        "pers robtargets": "PERS robtarget q{k}:=[[{k},2,3],[1,0,0,0],[0,0,0,0],[9E9,9E9,9E9,9E9,9E9,9E9]];\n",
        "jointtargets": "CONST jointtarget q{k}:=[[{k},2,3,4,5,6],[9E9,9E9,9E9,9E9,9E9,9E9]];\n",
        "tools": "PERS tooldata q{k}:=" + TOOL + ";\n",
        "wobjs": "PERS wobjdata q{k}:=" + WOBJ + ";\n",
        "lists": "VAR num n{k}:=[1,2,3];\n",
        "arrays": "CONST num n{k}{3}:=[1,2,3];\n",
        "names": "CONST num n{k}:=n{r};\n",
        "sums": "CONST num n{k}:=1+2;\n",
        "offsets": "CONST robtarget q{k}:=Offs(p0,{k},0,0);\n",
        "deep lists": "VAR num n{k}:=" + "[" * 45 + "1" + "]" * 45 + ";\n",
        "procs": "PROC r{k}()\nENDPROC\n",
        "procs with moves": "PROC r{k}()\nMoveL p0,v10,fine,tool0;\nENDPROC\n",
        "procs calling": "PROC r{k}()\nr{r};\nENDPROC\n",
        "procs calling unknown": "PROC r{k}()\nu{r};\nENDPROC\n",
        "procs calling one": "PROC r{k}()\nz;\nENDPROC\n",
        "procs assigning": "PROC r{k}()\ny:=1;\nENDPROC\n",
        "procs assigning each": "PROC r{k}()\ny:={k};\nENDPROC\n",
        "procs moving and assigning": "PROC r{k}()\nMoveL q,v10,fine,tool0;\nq:=Offs(p0,{k},0,0);\nENDPROC\n",
        "procs with parameters": "PROC r{k}(num a,num b\\num c)\nENDPROC\n",
        "procs with handlers": "PROC r{k}()\nERROR\nRETRY;\nENDPROC\n",
        "procs with handlers moving": "PROC r{k}()\ny:=1;\nERROR\nMoveL p0,v10,fine,tool0;\nRETRY;\nENDPROC\n",
        "procs with labels": "PROC r{k}()\na:\nGOTO a;\nENDPROC\n",
        "functions": "FUNC num r{k}()\nRETURN 1;\nENDFUNC\n",
        "traps": "TRAP r{k}\nENDTRAP\n",
        "traps moving": "TRAP r{k}\nMoveL p0,v10,fine,tool0;\nENDTRAP\n",
        "traps assigning": "TRAP r{k}\ny:=1;\nENDTRAP\n",
        "records": "RECORD r{k}\nnum a{k};\nrobtarget b{k};\nENDRECORD\n",
        "aliases": "ALIAS num r{k};\n",
        "local data": "PROC r{k}()\nVAR num a:=1;\nVAR num b;\nENDPROC\n",
    }
    module = (
        f"MODULE m\nCONST robtarget p0:={T};\nPERS robtarget q:={T};\nVAR num y:=0;\n",
        "PROC main()\nMoveL p0,v10,fine,tool0;\nENDPROC\nPROC z()\nENDPROC\nENDMODULE\n",
    )
    found = {**expressions, **raw, **{name: Kind(head, unit, tail) for name, unit in lines.items()}}
    found |= {"data: " + name: Kind(module[0], unit, module[1]) for name, unit in data.items()}
    found |= {
        "many modules": Kind("", "MODULE m{k}\nENDMODULE\n", head + tail),
        "many modules of one name": Kind("", "MODULE m\nLOCAL VAR num a;\nENDMODULE\n", head + tail),
        "many modules with names of their own": Kind("", "MODULE m{k}\nLOCAL VAR num a{k};\nPROC f{k}()\na{k}:=1;\nENDPROC\nENDMODULE\n", head + tail),
        "many constants hidden": Kind("MODULE m\n", "CONST num n{k}:=1;\nPROC f{k}()\nVAR num n{k};\nn{k}:=2;\nENDPROC\n", head.removeprefix("MODULE m\n") + tail),
        "many calls with optional arguments": Kind("MODULE m\nPROC o(num a" + "".join(f"\\num o{k}" for k in range(3_000)) + ")\nENDPROC\n" + head.removeprefix("MODULE m\n"), "o 1;\n", tail),
        "many parameters": Kind("MODULE m\nPROC f(", "num a{k},", "num b)\nENDPROC\nENDMODULE\n"),
        "many arguments": Kind(head + "g ", "1,", "1;\n" + tail),
        "many switches": Kind(head + "g 1", "\\s{k}", ";\n" + tail),
        "many targets in an array": Kind("MODULE m\nCONST robtarget p{9}:=[", "[[{k},2,3],[1,0,0,0],[0,0,0,0],[9E9,9E9,9E9,9E9,9E9,9E9]],", f"{T}];\nPROC main()\nMoveL p{{1}},v10,fine,tool0;\nENDPROC\nENDMODULE\n"),
        "many targets in a loop": Kind("MODULE m\nCONST robtarget p{9}:=[", "[[{k},2,3],[1,0,0,0],[0,0,0,0],[9E9,9E9,9E9,9E9,9E9,9E9]],", f"{T}];\nPROC main()\nFOR i FROM 1 TO 9 DO\nMoveL p{{i}},v10,fine,tool0;\nENDFOR\nENDPROC\nENDMODULE\n"),
        "many targets changed": Kind(f"MODULE m\nVAR robtarget p{{9}}:=[{T}];\nPROC main()\n", "p{{k}}:=[[{k},2,3],[1,0,0,0],[0,0,0,0],[9E9,9E9,9E9,9E9,9E9,9E9]];\n".replace("{{k}}", "{1}"), "MoveL p{1},v10,fine,tool0;\nENDPROC\nENDMODULE\n"),
        "many numbers in an array": Kind("MODULE m\nCONST num p{9}:=[", "{k},", "1];\n" + head.removeprefix("MODULE m\n") + tail),
        "many numbers chosen": Kind("MODULE m\nCONST num p{9}:=[", "{k},", "1];\n" + head.removeprefix("MODULE m\n") + "MoveL Offs(p1,p{a},0,0),v10,fine,tool0;\n" + tail),
        "many elseifs": Kind(head + "IF c THEN\n", "ELSEIF c THEN\nb:=1;\n", "ENDIF\n" + tail),
        "many elseifs each": Kind(head + "IF c THEN\n", "ELSEIF a={k} THEN\nb:={k};\n", "ENDIF\n" + tail),
        "many elseifs moving": Kind(head + "IF c THEN\n", "ELSEIF c THEN\nMoveL Offs(p1,{k},0,0),v10,fine,tool0;\n", "ENDIF\n" + tail),
        "many elseifs with targets": Kind(head + "IF c THEN\n", "ELSEIF c THEN\nv1:=Offs(p1,{k},0,0);\n", "ENDIF\nMoveL v1,v10,fine,tool0;\n" + tail),
        "many cases": Kind(head + "TEST a\n", "CASE {k}:\nb:=1;\n", "ENDTEST\n" + tail),
        "many cases each": Kind(head + "TEST a\n", "CASE {k}:\nb:={k};\n", "ENDTEST\n" + tail),
        "many cases moving": Kind(head + "TEST a\n", "CASE {k}:\nMoveL Offs(p1,{k},0,0),v10,fine,tool0;\n", "ENDTEST\n" + tail),
        "many cases with targets": Kind(head + "TEST a\n", "CASE {k}:\nv1:=Offs(p1,{k},0,0);\n", "ENDTEST\nMoveL v1,v10,fine,tool0;\n" + tail),
        "many cases calling": Kind(head + "TEST a\n", "CASE {k}:\nf;\n", "ENDTEST\n" + tail),
        "many numbers in a case": Kind(head + "TEST a\nCASE ", "{k},", "1:\nENDTEST\n" + tail),
        "many moves in a loop": Kind(head + "WHILE TRUE DO\n", "MoveL Offs(p1,{k},0,0),v10,fine,tool0;\n", "ENDWHILE\n" + tail),
        "many assignments in a loop": Kind(head + "WHILE TRUE DO\n", "x{k}:=x{r};\n", "ENDWHILE\n" + tail),
        "many after a label": Kind(head + "a:\n", "v1:=Offs(p1,{k},0,0);\n", "GOTO a;\nMoveL v1,v10,fine,tool0;\n" + tail),
        "many moves after a label": Kind(head + "a:\n", "MoveL Offs(p1,{k},0,0),v10,fine,tool0;\n", "GOTO a;\n" + tail),
        "many returns": Kind("MODULE m\nFUNC num f(num a)\n", "IF a=1 RETURN {k};\n", "ENDFUNC\n" + head.removeprefix("MODULE m\n") + "a:=k(f(1));\n" + tail),
        "if nest short": Kind(head, "IF c " * 50 + "b:={k};\n", tail),
        "if nest": Kind(head, "IF c THEN\n" * 50 + "b:={k};\n" + "ENDIF\n" * 50, tail),
        "if nest target": Kind(head, "IF c THEN\n" * 50 + "v1:=Offs(p1,{k},0,0);\n" + "ENDIF\n" * 50, "MoveL v1,v10,fine,tool0;\n" + tail),
        "if else nest": Kind(head, "IF c THEN\nb:=1;\nELSE\n" * 50 + "b:={k};\n" + "ENDIF\n" * 50, tail),
        "while nest": Kind(head, "WHILE c DO\n" * 10 + "b:=b+1;\n" + "ENDWHILE\n" * 10, tail),
        "while nest target": Kind(head, "WHILE c DO\n" * 5 + "v1:=Offs(v1,1,0,0);\n" + "ENDWHILE\n" * 5, tail),
        "for nest": Kind(head, "FOR n FROM 1 TO 2 DO\n" * 10 + "b:=b+1;\n" + "ENDFOR\n" * 10, tail),
        "test nest": Kind(head, "TEST a\nCASE 1:\n" * 50 + "b:={k};\n" + "ENDTEST\n" * 50, tail),
        "deep lists": Kind(head, "v1:=" + "[" * 50 + "1" + "]" * 50 + ";\n", tail),
        "deep lists moves": Kind(head, "MoveL " + "[" * 45 + "1" + "]" * 45 + ",v10,fine,tool0;\n", tail),
        "deep brackets": Kind(head, "a:=" + "(" * 50 + "1" + ")" * 50 + ";\n", tail),
        "deep not": Kind(head, "c:=" + "NOT " * 50 + "c;\n", tail),
        "deep minus": Kind(head, "a:=" + "-" * 50 + "a;\n", tail),
        "deep calls": Kind(head, "a:=" + "k(" * 50 + "1" + ")" * 50 + ";\n", tail),
        "deep sines": Kind(head, "a:=" + "Sin(" * 50 + "1" + ")" * 50 + ";\n", tail),
        "deep Offs": Kind(head, "MoveL " + "Offs(" * 45 + "p1" + ",1,0,{k})" * 45 + ",v10,fine,tool0;\n", tail),
        "deep RelTool": Kind(head, "MoveL " + "RelTool(" * 45 + "p1" + ",1,0,{k})" * 45 + ",v10,fine,tool0;\n", tail),
        "long chains": Kind(head, "a:=1" + "+a" * 900 + ";\n", tail),
        "long fields": Kind(head, "a:=v1" + ".trans" * 900 + ";\n", tail),
        "long indexes": Kind(head, "a:=l" + "{1}" * 900 + ";\n", tail),
        "call tree": Kind(
            f"MODULE m\nPROC main()\nz14 {T};\nENDPROC\nPROC z0(robtarget x)\nMoveL x,v10,fine,tool0;\nENDPROC\n" + "".join(f"PROC z{i}(robtarget x)\nz{i-1} Offs(x,1,0,0);\nz{i-1} Offs(x,2,0,0);\nENDPROC\n" for i in range(1, 15)),
            "! {k}\n", "ENDMODULE\n",
        ),
        "calls of calls": Kind(f"MODULE m\nPROC z0()\nMoveL {T},v10,fine,tool0;\nENDPROC\n", "PROC z{k}()\nz0;z0;\nENDPROC\n", "ENDMODULE\n"),
        "one long comment": Kind("!", "a", "\n" + head + tail),
        "one long text": Kind(head + 'TPWrite "', "a", '";\n' + tail),
        "one long text sent": Kind(head + 'SocketSend s\\Str:="', "MoveL ", '";\n' + tail),
        "one long name": Kind(head, "a", ";\n" + tail),
        "one unterminated text": Kind(head + 'TPWrite "', "a ", "\n" + tail),
        "unterminated texts": Kind(head, 'TPWrite "a;\n', tail),
        "blanks in a target": Kind(head + "MoveL [[1,2,3],", " ", "[1,0,0,0],[0,0,0,0],[9E9,9E9,9E9,9E9,9E9,9E9]],v10,fine,tool0;\n" + tail),
        "blanks before": Kind("", "\n", head + tail),
        "header": Kind("%%%\n", "VERSION:1\n", "%%%\n" + head + tail),
        "unterminated header": Kind("%%%\n", "VERSION:1\n", head + tail),
        "CAM moves": Kind(head, "MoveL [[{k}.123,-{r}.25,300.125],[0.00000001,0.70710678,0.70710678,0.00000001],[0,-1,0,0],[9E+09,9E+09,9E+09,9E+09,9E+09,9E+09]],v100,z1,t1\\WObj:=w1;\n", tail),
    }  # fmt: skip
    return found


URSCRIPT: Mapping[str, Kind] = _urscript()
RAPID: Mapping[str, Kind] = _rapid()
