"""Tests the release firmware with python-canopen over python-can's slcan interface, both unmodified."""

import queue
import time

import canopen
import pytest
from canopen import lss
from canopen.lss import LssError

from boards import EDS, Boards

VENDOR_ID, PRODUCT_CODE, REVISION_NUMBER = 0x0000_0000, 0x4C53_5334, 0x0001_0000
BOOT_UP, STOPPED, OPERATIONAL, PRE_OPERATIONAL = 0x00, 0x04, 0x05, 0x7F
# Much longer than necessary, for a busy computer.
PATIENCE = 20


class States:
    """The NMT states that a node reports by boot-up and heartbeat, in order."""

    def __init__(self, node):
        self.reported = queue.Queue()
        node.nmt.add_heartbeat_callback(self.reported.put)

    def wait_for(self, state):
        deadline = time.monotonic() + PATIENCE
        while self.reported.get(timeout=max(0, deadline - time.monotonic())) != state:
            pass


def connect(boards, bit_rate=125_000):
    network = boards.connect(bit_rate)
    network.lss.RESPONSE_TIMEOUT = PATIENCE
    return network


def add_node(network, node_id, eds=EDS):
    node = network.add_node(node_id, eds)
    node.sdo.RESPONSE_TIMEOUT = PATIENCE
    return node


def identity(boards):
    serial_number, *_ = boards.serial_numbers
    return VENDOR_ID, PRODUCT_CODE, REVISION_NUMBER, serial_number


def test_fast_scan_finds_a_blank_board_and_lss_configures_it_for_good(tmp_path):
    with Boards("--flash", tmp_path) as boards, connect(boards) as network:
        master = network.lss
        # The scan recognises a 1 by the absence of an answer, so its time-out determines its speed.
        master.RESPONSE_TIMEOUT = 0.25
        assert master.fast_scan() == (True, list(identity(boards)))
        master.RESPONSE_TIMEOUT = PATIENCE
        assert master.inquire_node_id() == 0xFF
        asked = [lss.CS_INQUIRE_VENDOR_ID, lss.CS_INQUIRE_PRODUCT_CODE]
        asked += [lss.CS_INQUIRE_REVISION_NUMBER, lss.CS_INQUIRE_SERIAL_NUMBER]
        assert tuple(map(master.inquire_lss_address, asked)) == identity(boards)
        with pytest.raises(LssError, match="LSS Error: 1"):
            master.configure_node_id(128)
        with pytest.raises(LssError, match="LSS Error: 1"):
            master.configure_bit_timing(5)
        node = add_node(network, 42)
        states = States(node)
        master.configure_node_id(42)
        master.store_configuration()
        assert master.inquire_node_id() == 0xFF, "active after the next reset"
        master.send_switch_state_global(master.WAITING_STATE)
        states.wait_for(BOOT_UP)
        states.wait_for(PRE_OPERATIONAL)

    with Boards("--flash", tmp_path) as boards, connect(boards) as network:
        States(add_node(network, 42)).wait_for(PRE_OPERATIONAL)
        network.lss.RESPONSE_TIMEOUT = 1
        assert network.lss.fast_scan() == (False, None)


def test_switch_selective_reaches_the_addressed_board_alone():
    with Boards("--boards", 2, "--node-id", 7) as boards, connect(boards) as network:
        master = network.lss
        product = VENDOR_ID, PRODUCT_CODE, REVISION_NUMBER
        for node_id, serial_number in enumerate(boards.serial_numbers, start=7):
            assert master.send_switch_state_selective(*product, serial_number)
            assert master.inquire_node_id() == node_id
            assert master.inquire_lss_address(lss.CS_INQUIRE_SERIAL_NUMBER) == serial_number
            master.send_switch_state_global(master.WAITING_STATE)


def test_bit_timing_is_configured_activated_and_stored(tmp_path):
    with Boards("--node-id", 5, "--flash", tmp_path) as boards:
        with connect(boards) as network:
            assert network.lss.send_switch_state_selective(*identity(boards))
            network.lss.configure_bit_timing(2)
            delay = 2.0
            network.lss.activate_bit_timing(int(delay * 1000))
            requested = time.monotonic()
        # During the first delay the board is silent, so the change of the master's bit rate goes unnoticed.
        with connect(boards, 500_000) as network:
            states = States(add_node(network, 5))
            time.sleep(max(0, requested + delay - time.monotonic()))
            states.wait_for(PRE_OPERATIONAL)
            assert network.lss.inquire_node_id() == 5
            network.lss.store_configuration()

    with Boards("--flash", tmp_path) as boards, connect(boards, 500_000) as network:
        States(add_node(network, 5)).wait_for(PRE_OPERATIONAL)


def test_heartbeats_tell_the_nmt_states():
    with Boards("--node-id", 5) as boards, connect(boards) as network:
        node = add_node(network, 5)
        states = States(node)
        node.sdo[0x1017].raw = 100
        assert node.sdo[0x1017].raw == 100
        states.wait_for(PRE_OPERATIONAL)
        for command, state in [
            ("OPERATIONAL", OPERATIONAL),
            ("STOPPED", STOPPED),
            ("PRE-OPERATIONAL", PRE_OPERATIONAL),
            ("RESET COMMUNICATION", BOOT_UP),
            ("OPERATIONAL", OPERATIONAL),
            ("RESET", BOOT_UP),
        ]:
            node.nmt.state = command
            states.wait_for(state)
        states.wait_for(PRE_OPERATIONAL)
        assert node.sdo[0x1017].raw == 1000, "it was not stored"
