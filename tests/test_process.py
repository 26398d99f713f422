"""How the process of a command begins and ends."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from cases import BAR, write_study


def process(code: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False)


def test_a_run_parses_no_c_and_leaves_dolfinx_whole(tmp_path: Path) -> None:
    """What is kept out is there for those who ask for it: PETSc's function from DOLFINx's own binding."""
    path = write_study(tmp_path / "bar.toml", BAR)
    result = process(f"""
import sys; sys.argv = ['fracsim', 'run', {str(path)!r}, '-o', {str(tmp_path / "out")!r}]
from fracsim.cli import main
try: main()
finally:
    print([name for name in ('pycparser', 'dolfinx.utils', 'scipy') if name in sys.modules])
    from dolfinx.utils import ctypes_utils
    print(ctypes_utils.MatSetValuesLocal.__name__)
""")
    assert result.returncode == 0, result.stderr
    assert result.stdout.splitlines()[-2:] == ["[]", "MatSetValuesLocal"]


@pytest.mark.parametrize("thread", [False, True])
def test_a_process_is_left_as_by_sys_exit(thread: bool) -> None:
    """What was said is told, what was to be done at the end is done, MPI is finalised, no thread is cut off."""
    begin = "threading.Thread(target=lambda: (time.sleep(0.2), print('thread'))).start()" if thread else ""
    result = process(f"""
import atexit, threading, time
from petsc4py import PETSc
from mpi4py import MPI
from fracsim.process import leave
atexit.register(lambda: print('end'))
kept = PETSc.Vec().createSeq(3)
class Attribute: pass
def told(*_): print('finalised', flush=True); return None
MPI.COMM_SELF.Set_attr(MPI.Comm.Create_keyval(delete_fn=told), Attribute())
{begin}
print('said')
leave(3)
""")
    assert result.returncode == 3, result.stderr
    said = result.stdout.split()
    # a thread is waited for by the interpreter, which is gone by the time that it finalises MPI
    assert said == (["said", "thread", "end"] if thread else ["said", "end", "finalised"])
    assert result.stderr == ""
