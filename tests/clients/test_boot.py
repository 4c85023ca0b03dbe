"""Plays the full master of boot.py (CiA 302-2) with boards of the example `io` and the files of dcfgen."""

import re
import socket
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

import boot
from boards import HERE, WORKSPACE, Boards
from test_python_canopen import OPERATIONAL, PATIENCE, States

EXAMPLE = "--example", "io", "--boards"
STAMP = 15645, 36_000_000
COUNT = 20
# Of bus time, from the first NMT command of the master on.
LIMIT_MS = 5000


def configuration(folder, count, **of_first_board):
    """Runs dcfgen with the first boards of network.yml, and with more or other keys for board 1."""
    network = yaml.safe_load((HERE / "network.yml").read_text())
    names = ["master", *(f"board_{number}" for number in range(1, count + 1))]
    chosen = {name: network[name] for name in names}
    chosen["board_1"] = chosen["board_1"] | of_first_board
    folder.mkdir()
    (folder / "network.yml").write_text(yaml.safe_dump(chosen))
    dcfgen = Path(sys.executable).parent / "dcfgen"
    subprocess.run([dcfgen, "-d", folder, folder / "network.yml"], cwd=WORKSPACE, check=True)
    return boot.Configuration(folder)


def stamp(network, node_id):
    """Date and time of the configuration in the node."""
    return tuple(int.from_bytes(network[node_id].sdo.upload(*key), "little") for key in boot.STAMP)


def boots(boards, configured):
    """Boots the network, and returns which nodes have had a download."""
    with boards.connect() as network:
        return boot.boot(network, configured)


def test_a_node_is_configured_once_and_again_only_after_a_change(tmp_path):
    configured = configuration(tmp_path / "dcf", 2)
    arguments = *EXAMPLE, 2, "--node-id", 1, "--flash", tmp_path / "flash"
    with Boards(*arguments) as boards:
        assert boots(boards, configured) == {1: True, 2: True}
        assert boots(boards, configured) == {1: False, 2: False}

    with Boards(*arguments) as boards, boards.connect() as network:
        assert boot.boot(network, configured) == {1: False, 2: False}, "stored"
        first, second = (States(network[node_id]) for node_id in (1, 2))
        first.wait_for(OPERATIONAL)
        second.wait_for(OPERATIONAL)
        assert stamp(network, 1) == STAMP
        network[1].sdo.download(0x2100, 0, bytes([4]))
        assert boot.boot(network, configured) == {1: False, 2: False}, "the same value is no change"
        network[1].sdo.download(0x2100, 0, bytes([5]))
        assert stamp(network, 1) == (0, 0)
        assert boot.boot(network, configured) == {1: True, 2: False}
        assert network[1].sdo.upload(0x2100, 0) == bytes([4])

    other_stamp = yaml.safe_load((HERE / "network.yml").read_text())["board_1"]["sdo"]
    other_stamp[2]["value"] += 1
    with Boards(*arguments) as boards:
        changed = configuration(tmp_path / "changed", 2, sdo=other_stamp)
        assert boots(boards, changed) == {1: True, 2: False}
        assert boots(boards, changed) == {1: False, 2: False}


def test_a_node_that_is_not_the_expected_one_is_neither_configured_nor_started(tmp_path):
    with Boards(*EXAMPLE, 2, "--node-id", 1) as boards:
        here, elsewhere = boards.serial_numbers
        right = configuration(tmp_path / "right", 1, serial_number=here)
        wrong = configuration(tmp_path / "wrong", 1, serial_number=elsewhere)
        with boards.connect() as network:
            with pytest.raises(boot.Refused, match=f"node 1: 1018h sub 4 is {here:X}h, not {elsewhere:X}h"):
                boot.boot(network, wrong)
            assert stamp(network, 1) == (0, 0)
            assert network[1].nmt.wait_for_heartbeat(PATIENCE) == "PRE-OPERATIONAL"
            assert boot.boot(network, right) == {1: True}


class BusLog:
    """The frames on the bus, with the milliseconds of the emulated adapter, which are those of the bus."""

    def __init__(self, boards):
        host, port = boards.address.split(":")
        self.socket = socket.create_connection((host, int(port)))
        self.socket.settimeout(PATIENCE)
        self.socket.sendall(b"S4\rZ1\rL\r")
        self.rest = b""
        # The clock of the adapter wraps every minute.
        self.wraps, self.last = 0, 0

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.socket.close()

    def frames(self):
        """Yields time in ms, COB-ID and data."""
        while True:
            *lines, self.rest = (self.rest + self.socket.recv(4096)).split(b"\r")
            for line in lines:
                frame = re.fullmatch(rb"t(\w{3})\d(\w*)(\w{4})", line)
                if frame is None:
                    continue
                now = int(frame[3], 16)
                self.wraps += now < self.last
                self.last = now
                yield 60_000 * self.wraps + now, int(frame[1], 16), bytes.fromhex(frame[2].decode())


def test_20_boards_that_lss_has_commissioned_exchange_pdos_within_5_s(tmp_path):
    configured = configuration(tmp_path / "dcf", COUNT)
    with Boards(*EXAMPLE, COUNT) as boards:
        code, assigned = boards.lss("assign")
        assert code == 0
        verified = re.findall(r"^node (\d+) .* verified by a reset$", assigned, re.MULTILINE)
        assignment = [int(node_id) for node_id in verified]
        assert sorted(assignment) == list(range(1, COUNT + 1))
        with BusLog(boards) as log, boards.connect() as network:
            assert all(boot.boot(network, configured).values())
            for node_id in assignment:
                network.send_message(0x200 + node_id, bytes([1]))
            network.sync.transmit()
            begin, sent = None, {}
            frames = log.frames()
            while len(sent) < COUNT:
                now, cob_id, data = next(frames)
                if cob_id == 0x000 and begin is None:
                    begin = now
                if cob_id - 0x180 in assignment:
                    sent[cob_id - 0x180] = now - begin, data
        last = max(now for now, _ in sent.values())
        print(f"{COUNT} boards: all PDOs {last} ms after the first NMT command")
        assert last <= LIMIT_MS
        # A button that is not pressed, and a temperature in 0.1 degrees.
        assert all(data[0] == 0 and 200 <= int.from_bytes(data[1:3], "little") <= 300 for _, data in sent.values())
        dark = {f"board {number}: LED 1 on, LED 2 off" for number in range(COUNT)}
        while dark:
            dark.discard(boards.lines.get(timeout=PATIENCE))
        _, printed, complaints = boards.run_script("boot.py", tmp_path / "dcf")
        assert printed.count("as configured before, started\n") == COUNT, complaints
