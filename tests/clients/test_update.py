"""python-canopen, npm canopen and `lss update` install a new program on emulated boards with a loader."""

import subprocess
import zlib

import pytest

from boards import BUILD_TIMEOUT, HERE, WORKSPACE, Boards
from test_npm_canopen import ENVIRONMENT

CHIP = "stm32f407"
NODE_IDS = 1, 2
HEADER = 512


@pytest.fixture(scope="module")
def kit(tmp_path_factory):
    """The files of a release with a loader."""
    folder = tmp_path_factory.mktemp("kit")
    command = ["cargo", "run", "--quiet", "--package", "xtask", "--", "dist"]
    subprocess.run([*command, "--out", folder, CHIP], cwd=WORKSPACE, check=True, timeout=BUILD_TIMEOUT)
    return folder / f"{CHIP}-update"


def with_header(header, program):
    """An update file with this header, whose checksums are made right."""
    header[12:16] = zlib.crc32(program).to_bytes(4, "little")
    header[252:256] = zlib.crc32(header[:252]).to_bytes(4, "little")
    return bytes(header) + program


def newer(file):
    """The same program as version 0.2.0."""
    header, program = bytearray(file[:HEADER]), file[HEADER:].replace(b"0.1.0", b"0.2.0")
    header[28:32] = (2 << 10).to_bytes(4, "little")
    header[60:65] = b"0.2.0"
    return with_header(header, program)


def for_another_chip(file):
    """The same file for an STM32F446."""
    header = bytearray(file[:HEADER])
    header[32:41] = b"stm32f446"
    return with_header(header, file[HEADER:])


@pytest.fixture
def boards(kit):
    factory = kit / "factory.hex"
    with Boards("--boards", 0, "--chip", CHIP, *["--elf", factory] * len(NODE_IDS)) as boards:
        code, _, complaints = boards.run_script("commission.py", 0.1)
        assert code == 0, complaints
        yield boards


def assert_runs(boards, file, node_ids=NODE_IDS):
    """Each board runs the program in this file, and keeps it."""
    with boards.connect() as network:
        for node_id in node_ids:
            sdo = network.add_node(node_id).sdo
            assert sdo.upload(0x1F56, 1) == file[12:16]
            assert sdo.upload(0x1F51, 1) == b"\1"
            assert sdo.upload(0x2001, 1) == b"\3", "kept"


def test_python_canopen_installs_a_program_on_two_boards(kit, boards, tmp_path):
    file = newer((kit / "lss-node.update.bin").read_bytes())
    path = tmp_path / "newer.update.bin"
    path.write_bytes(file)
    code, printed, complaints = boards.run_script("update.py", 125, path, *NODE_IDS)
    assert code == 0, complaints
    assert printed.splitlines() == [f"node {node_id}: 0.2.0, confirmed" for node_id in NODE_IDS]
    assert_runs(boards, file)
    code, printed = boards.lss("update", path)
    assert code == 0
    assert printed.count("0.2.0, has it already") == len(NODE_IDS)


def test_npm_canopen_installs_a_program_on_a_board(kit, boards, tmp_path):
    file = newer((kit / "lss-node.update.bin").read_bytes())
    path = tmp_path / "newer.update.bin"
    path.write_bytes(file)
    port = boards.address.rpartition(":")[2]
    command = ["node", HERE / "node" / "update.js", port, "1", kit / "lss-node.eds", path]
    subprocess.run(command, env=ENVIRONMENT, check=True, timeout=180)
    assert_runs(boards, file, [1])


def test_lss_installs_a_program_and_refuses_one_for_another_chip(kit, boards, tmp_path):
    first = (kit / "lss-node.update.bin").read_bytes()
    path = tmp_path / "other.update.bin"
    path.write_bytes(for_another_chip(newer(first)))
    code, _ = boards.lss("update", path)
    assert code == 1
    path.write_bytes(newer(first))
    code, printed = boards.lss("update", path)
    assert code == 0
    assert printed.count("0.1.0 -> 0.2.0, confirmed") == len(NODE_IDS)
    assert_runs(boards, newer(first))
