"""Tests the release firmware with the npm package canopen: node/session.js, node/example.js."""

import os
import subprocess
import threading

from boards import EDS, HERE, WORKSPACE, Boards

MODULES = WORKSPACE / "target" / "clients-node" / "node_modules"
ENVIRONMENT = {**os.environ, "NODE_PATH": str(MODULES)}


def test_npm_canopen_commissions_and_uses_a_blank_board():
    with Boards() as boards:
        port = boards.address.rpartition(":")[2]
        serial_number = f"{boards.serial_numbers[0]:08X}"
        command = ["node", HERE / "node" / "session.js", port, serial_number, EDS]
        subprocess.run(command, env=ENVIRONMENT, check=True, timeout=180)


def test_npm_canopen_exchanges_pdos_with_the_example():
    with Boards("--example", "io", "--node-id", 5) as boards:
        port = boards.address.rpartition(":")[2]
        eds = WORKSPACE / "eds" / "io.eds"
        command = ["node", HERE / "node" / "example.js", port, "5", eds]
        with subprocess.Popen(
            command, env=ENVIRONMENT, stdout=subprocess.PIPE, text=True
        ) as session:
            too_late = threading.Timer(180, session.kill)
            too_late.start()
            for event in session.stdout:
                boards.command(event.strip())
            too_late.cancel()
        assert session.returncode == 0
        boards.wait_for_line("board 0: LED 1 on, LED 2 on", 20)
