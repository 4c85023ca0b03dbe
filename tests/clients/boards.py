"""Emulated boards, started and stopped, and a python-canopen network on their bus."""

import queue
import re
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import canopen

HERE = Path(__file__).resolve().parent
WORKSPACE = HERE.parents[1]
EDS = str(WORKSPACE / "eds" / "lss-slave.eds")
# The first bus waits for a cold build of the emulator and the firmware.
BUILD_TIMEOUT = 1200


class Boards:
    """`cargo emulate` on a free port, with these arguments; leaving the context switches the power off."""

    def __init__(self, *arguments):
        command = ["cargo", "run", "--quiet", "--package", "xtask", "--", "emulate"]
        self.process = subprocess.Popen(
            [*command, "--listen", "127.0.0.1:0", *map(str, arguments)],
            cwd=WORKSPACE,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        too_late = threading.Timer(BUILD_TIMEOUT, self.process.kill)
        too_late.start()
        self.description = self.process.stdout.readline()
        too_late.cancel()
        ready = re.match(r"ready: SLCAN on ([\d.]+:\d+); ", self.description)
        if ready is None:
            self.process.kill()
            raise AssertionError(f"cargo emulate says {self.description!r} instead of ready")
        self.address = ready[1]
        serial_numbers = re.findall(r"serial number (\w{8})", self.description)
        self.serial_numbers = [int(number, 16) for number in serial_numbers]
        self.lines = queue.Queue()
        self.reader = threading.Thread(target=self._read, daemon=True)
        self.reader.start()

    def _read(self):
        for line in self.process.stdout:
            self.lines.put(line.rstrip())

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.process.send_signal(signal.SIGINT)
        try:
            assert self.process.wait(timeout=60) == 0
        finally:
            self.process.kill()
            self.reader.join()
            self.process.stdin.close()
            self.process.stdout.close()

    def command(self, line):
        """Gives the example a command, such as `button down`."""
        self.process.stdin.write(f"{line}\n")
        self.process.stdin.flush()

    def wait_for_line(self, expected, timeout):
        """Waits until the example prints this line."""
        deadline = time.monotonic() + timeout
        others = []
        while True:
            try:
                line = self.lines.get(timeout=max(0, deadline - time.monotonic()))
            except queue.Empty:
                raise AssertionError(f"cargo emulate printed {others}, not {expected!r}") from None
            if line == expected:
                return
            others.append(line)

    @property
    def channel(self):
        """The adapter's channel in python-can."""
        return f"socket://{self.address}"

    def lss(self, *arguments):
        """Runs the tool `lss` of this repository on the bus; returns its exit code and what it printed."""
        command = ["cargo", "run", "--quiet", "--package", "lss", "--"]
        adapter = "--adapter", f"slcan:tcp:{self.address}"
        command += [*adapter, *map(str, arguments)]
        tool = subprocess.run(command, cwd=WORKSPACE, capture_output=True, text=True, timeout=BUILD_TIMEOUT)
        print(tool.stdout, tool.stderr)
        return tool.returncode, tool.stdout

    def run_script(self, script, *arguments):
        """Runs a script of this folder on the bus; returns its exit code, what it printed and its complaints."""
        command = [sys.executable, HERE / script, self.channel, *map(str, arguments)]
        script = subprocess.run(command, capture_output=True, text=True, timeout=600)
        print(script.stdout)
        return script.returncode, script.stdout, script.stderr

    def connect(self, bit_rate=125_000, network=None):
        """Connects a python-canopen network to the bus, a new one by default, for use as a context."""
        network = network or canopen.Network()
        # python-can waits for an Arduino to start after opening; there is none here.
        network.connect(
            interface="slcan", channel=self.channel, bitrate=bit_rate, sleep_after_open=0
        )
        return network
