"""Emulated boards, started and stopped, and a python-canopen network on their bus."""

import re
import signal
import subprocess
import threading
from pathlib import Path

import canopen

WORKSPACE = Path(__file__).resolve().parents[2]
# The first bus waits for a cold build of the emulator and the firmware.
BUILD_TIMEOUT = 1200


class Boards:
    """`cargo emulate` on a free port, with these arguments; leaving the context switches the power off."""

    def __init__(self, *arguments):
        command = ["cargo", "run", "--quiet", "--package", "xtask", "--", "emulate"]
        self.process = subprocess.Popen(
            [*command, "--listen", "127.0.0.1:0", *map(str, arguments)],
            cwd=WORKSPACE,
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

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.process.send_signal(signal.SIGINT)
        try:
            assert self.process.wait(timeout=60) == 0
        finally:
            self.process.kill()
            self.process.stdout.close()

    @property
    def channel(self):
        """The adapter's channel in python-can."""
        return f"socket://{self.address}"

    def connect(self, bit_rate=125_000, network=None):
        """Connects a python-canopen network to the bus, a new one by default, for use as a context."""
        network = network or canopen.Network()
        # python-can waits for an Arduino to start after opening; there is none here.
        network.connect(
            interface="slcan", channel=self.channel, bitrate=bit_rate, sleep_after_open=0
        )
        return network
