"""What the benchmarks say of CPU time and memory."""

import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks.usage import cpu_seconds, peak_mb, resident_mb

BUSY = """
import time
memory = bytearray(50 * 2**20)
while time.process_time() < 0.5: pass
print(flush=True)
input()
"""

pytestmark = pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="the benchmarks read /proc, as on Linux")


def test_processes_that_were_started_count_while_they_run_and_afterwards():
    before = cpu_seconds(), resident_mb()
    process = subprocess.Popen([sys.executable, "-c", BUSY], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    process.stdout.readline()
    running = cpu_seconds() - before[0]
    assert 0.45 < running < 1.5
    assert 50 < resident_mb() - before[1] < 150
    assert peak_mb() >= resident_mb()
    process.communicate(b"\n")
    assert running - 0.02 < cpu_seconds() - before[0] < running + 0.5
    assert resident_mb() - before[1] < 25
