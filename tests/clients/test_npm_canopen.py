"""Tests the release firmware with the npm package canopen: node/session.js."""

import os
import shutil
import subprocess
from pathlib import Path

import pytest

from boards import WORKSPACE, Boards

SESSION = Path(__file__).parent / "node" / "session.js"
MODULES = WORKSPACE / "target" / "clients-node" / "node_modules"


@pytest.mark.skipif(shutil.which("npm") is None, reason="npm is missing")
def test_npm_canopen_commissions_and_uses_a_blank_board():
    with Boards() as boards:
        port = boards.address.rpartition(":")[2]
        serial_number = f"{boards.serial_numbers[0]:08X}"
        eds = WORKSPACE / "eds" / "lss-slave.eds"
        subprocess.run(
            ["node", SESSION, port, serial_number, eds],
            env={**os.environ, "NODE_PATH": str(MODULES)},
            check=True,
            timeout=180,
        )
