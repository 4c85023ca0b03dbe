"""A run of commission.py gives every blank board on the bus its own node-ID and stores it."""

import re

import pytest

from boards import EDS, Boards

# The number of boards and the master's time-out in seconds, which is longer for more boards on one computer.
BUSES = [(1, 0.1), (5, 0.1)]


def commission(boards, timeout):
    """Runs the script. Returns the serial number at each node-ID that it gave, and what it printed."""
    code, printed, complaints = boards.run_script("commission.py", timeout)
    assert code == 0, complaints
    said = re.findall(r"node (\d+): serial number (\w{8})", printed)
    return {int(node_id): int(number, 16) for node_id, number in said}, printed


def serial_numbers_by_sdo(network, count):
    read = {}
    for node_id in range(1, count + 1):
        node = network.add_node(node_id, EDS)
        node.sdo.RESPONSE_TIMEOUT = 10
        read[node_id] = node.sdo[0x1018][4].raw
    return read


@pytest.mark.parametrize(("count", "timeout"), BUSES)
def test_every_board_ends_with_its_own_node_id_stored_and_booted(count, timeout, tmp_path):
    arguments = "--boards", count, "--flash", tmp_path
    with Boards(*arguments) as boards:
        assert boards.description.count("blank") == count
        assignment, _ = commission(boards, timeout)
        assert sorted(assignment) == list(range(1, count + 1))
        assert sorted(assignment.values()) == sorted(boards.serial_numbers)
        with boards.connect() as network:
            assert serial_numbers_by_sdo(network, count) == assignment

    with Boards(*arguments) as boards:
        assert "blank" not in boards.description
        with boards.connect() as network:
            assert serial_numbers_by_sdo(network, count) == assignment
            network.lss.RESPONSE_TIMEOUT = 1
            assert network.lss.fast_scan() == (False, None), "a board is still blank"


def test_a_node_id_in_use_is_not_given_again(tmp_path):
    count, timeout = 3, 0.1
    arguments = "--boards", count, "--flash", tmp_path
    with Boards(*arguments) as boards:
        before, _ = commission(boards, timeout)
        assert sorted(before) == [1, 2, 3]
        numbers = {serial_number: number for number, serial_number in enumerate(boards.serial_numbers)}
    for node_id in 1, 3:
        (tmp_path / f"board-{numbers[before[node_id]]}.bin").unlink()

    with Boards(*arguments) as boards:
        assert boards.description.count("blank") == 2
        after, _ = commission(boards, timeout)
        assert sorted(after) == [1, 3]
        with boards.connect() as network:
            assert serial_numbers_by_sdo(network, count) == after | {2: before[2]}
        assert commission(boards, timeout) == ({}, "0 boards have got a node-ID\n")
