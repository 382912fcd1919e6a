"""A process for which a test waits in vain is reported and killed."""

import subprocess
import sys

IN_VAIN = """
import subprocess, sys
def in_vain():
    child = subprocess.Popen([sys.executable, "-c", "import time; print('ready', flush=True); time.sleep(1000)"])
    child.wait()
in_vain()
"""
TEST = f"""
import os, subprocess, sys
from tests import hanging
process = subprocess.Popen([sys.executable, "-c", {IN_VAIN!r}], stdout=subprocess.PIPE)
assert process.stdout.readline() == b"ready\\n"
assert process.pid in hanging.descendants(os.getpid()) and len(hanging.descendants(os.getpid())) == 2
def tell(processes):
    assert process.poll() is None  # the test that waits for it has not failed yet
    print(processes)
hanging.end_all(os.getpid(), tell, patience=0.2)
assert process.wait(30) < 0 and process.stdout.read() == b""  # which ends when its child has ended, too
hanging.end_all(os.getpid(), print)
"""


def test_a_process_and_its_child_are_told_and_killed():
    """In a separate process, because this one may have a browser."""
    said = subprocess.run([sys.executable, "-c", TEST], capture_output=True, text=True, timeout=60)
    assert said.returncode == 0, said.stderr
    assert "time.sleep(1000)" in said.stdout and said.stdout.endswith("it has started no process\n")
    assert "in in_vain" in said.stderr  # where it hung, by PYTHONFAULTHANDLER, which conftest.py sets
