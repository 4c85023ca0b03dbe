"""Tests with python-canopen a board whose stored bit rate is not that of the bus."""

import struct
import time

import canopen

from boards import EDS, Boards

AWAY_FROM_HOME_RATE, NO_ERROR = 0xFF10, 0x0000
ASSIGNED, SPARE_PART = 5, 6


def wait_for_emergency(node, code):
    """The first emergency message with this code that python-canopen has received, or receives within 10 s."""
    deadline = time.monotonic() + 10
    while time.monotonic() < deadline:
        for emergency in list(node.emcy.log):
            if emergency.code == code:
                return emergency
        time.sleep(0.01)
    raise AssertionError(f"no emergency {code:04X}, but {node.emcy.log}")


def wait_for_answer(node):
    """Reads the device type until the board answers, for at most 10 s."""
    deadline = time.monotonic() + 10
    while time.monotonic() < deadline:
        try:
            return node.sdo["Device type"].raw
        except canopen.SdoCommunicationError:
            continue
    raise AssertionError("no answer")


def bit_rates_and_rescues(node):
    names = "Home bit rate", "Bit rate in use", "Rescues"
    return tuple(node.sdo["CAN controller"][name].raw for name in names)


def test_a_rescued_board_says_so_and_stores_the_rate_found_after_15(tmp_path):
    arguments = "--node-id", SPARE_PART, "--bit-rate", 500, "--flash", tmp_path
    with Boards(*arguments) as boards, boards.connect(125_000) as network:
        node = network.add_node(SPARE_PART, EDS)
        began = time.monotonic()
        # It answers, and reports itself with its first answer.
        wait_for_answer(node)
        emergency = wait_for_emergency(node, AWAY_FROM_HOME_RATE)
        print(f"rescued: {emergency} with {emergency.data.hex(' ')}", end=" ")
        print(f"within {time.monotonic() - began:.2f} s of the first request")
        in_use_and_home = struct.unpack("<HHx", emergency.data)
        assert in_use_and_home == (125, 500)
        assert bit_rates_and_rescues(node) == (500, 125, 1)
        assert node.sdo["Pre-defined error field"][1].raw == 125 << 16 | AWAY_FROM_HOME_RATE
        assert node.sdo["Error behaviour"]["Communication error"].raw == 0

        master = network.lss
        master.send_switch_state_global(master.CONFIGURATION_STATE)
        assert master.inquire_node_id() == SPARE_PART
        master.configure_node_id(ASSIGNED)
        master.store_configuration()
        assert bit_rates_and_rescues(node) == (500, 125, 1), "17 leaves the home rate"
        assert node.emcy.active
        master.activate_bit_timing(0)
        wait_for_emergency(node, NO_ERROR)
        assert not node.emcy.active
        assert bit_rates_and_rescues(node) == (125, 125, 1)
        master.store_configuration()

    with Boards(*arguments) as boards, boards.connect(125_000) as network:
        assert f"node-ID {ASSIGNED}, 125 kbit/s" in boards.description
        assert bit_rates_and_rescues(network.add_node(ASSIGNED, EDS)) == (125, 125, 0)
