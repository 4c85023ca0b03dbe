"""Tests the example with inputs and outputs (`examples/io`) with python-canopen, unmodified, and its data sheet."""

import queue
import time

import canopen
import pytest

from boards import WORKSPACE, Boards
from test_python_canopen import (
    OPERATIONAL,
    PATIENCE,
    PRE_OPERATIONAL,
    States,
    add_node,
    connect,
)
from test_rescue import NO_ERROR, wait_for_emergency

EDS = str(WORKSPACE / "eds" / "io.eds")
# With a second board the first is never alone on the bus, which would make it error passive.
EXAMPLE = "--example", "io", "--boards", 2
NODE_ID, MASTER = 5, 127
HEARTBEAT_LOST = 0x8130
# Abort codes of SDO.
READ_ONLY, NOT_MAPPABLE, TOO_LONG, TOO_HIGH = "06010002", "06040041", "06070012", "06090031"


class Reception:
    """The messages of a PDO, in order, as lists of the mapped values."""

    def __init__(self, pdo):
        self.received = queue.Queue()
        pdo.add_callback(lambda pdo: self.received.put([variable.raw for variable in pdo]))

    def wait_until(self, is_expected):
        deadline = time.monotonic() + PATIENCE
        while not is_expected(values := self.next(deadline - time.monotonic())):
            pass
        return values

    def next(self, timeout=PATIENCE):
        return self.received.get(timeout=max(0, timeout))


def set_state(node, command, state):
    states = States(node)
    node.nmt.state = command
    states.wait_for(state)


@pytest.fixture
def boards():
    with Boards(*EXAMPLE, "--node-id", NODE_ID) as boards:
        yield boards


@pytest.fixture
def network(boards):
    with connect(boards) as network:
        yield network


@pytest.fixture
def node(network):
    return add_node(network, NODE_ID, canopen.import_od(EDS, NODE_ID))


def assert_refused(code, transfer, *arguments):
    with pytest.raises(canopen.SdoAbortedError, match=f"0x{code}"):
        transfer(*arguments)


def test_the_values_of_the_example_survive_a_power_cycle(tmp_path):
    arguments = *EXAMPLE, "--node-id", NODE_ID, "--flash", tmp_path
    with Boards(*arguments) as boards, connect(boards) as network:
        node = add_node(network, NODE_ID, EDS)
        node.sdo["Filter constant of the temperature"].raw = 6
        node.sdo[0x6426][1].raw = 20
        node.sdo[0x1017].raw = 250
        node.store()
        node.sdo[0x6426][1].raw = 30

    with Boards(*arguments) as boards, connect(boards) as network:
        node = add_node(network, NODE_ID, EDS)
        assert parameters(node) == (6, 20, 250)
        node.restore()
        set_state(node, "RESET", PRE_OPERATIONAL)
        assert parameters(node) == (3, 5, 1000), "the defaults"


def parameters(node):
    """The stored values: filter constant, delta, and time between heartbeats."""
    return node.sdo[0x2100].raw, node.sdo[0x6426][1].raw, node.sdo[0x1017].raw


def test_a_value_is_written_within_its_limits_only(node):
    filter_constant = node.object_dictionary[0x2100]
    assert (filter_constant.min, filter_constant.max) == (0, 8)
    for value in filter_constant.min, filter_constant.max:
        node.sdo[0x2100].raw = value
        assert node.sdo[0x2100].raw == value
    assert_refused(TOO_HIGH, node.sdo.download, 0x2100, 0, bytes([filter_constant.max + 1]))
    assert_refused(TOO_LONG, node.sdo.download, 0x2100, 0, bytes(2))
    assert_refused(READ_ONLY, node.sdo.download, 0x6000, 1, bytes(1))
    assert node.sdo[0x2100].raw == filter_constant.max


def test_real_and_64_bit_numbers_and_strings_are_written_and_read(node):
    calibration = node.sdo["Calibration of the temperature"]
    for name, value in ("Gain", 1.25), ("Time in milliseconds since 1970", -(2**40)), ("Inspector", "A. Lovelace"):
        calibration[name].raw = value
        assert calibration[name].raw == value
    assert_refused(TOO_HIGH, node.sdo.download, 0x2101, 1, calibration["Gain"].od.encode_raw(2.5))


def test_block_and_segmented_transfers_carry_strings_and_numbers(node):
    for mode, expected in [("rb", b"LSS slave"), ("rt", "LSS slave")]:
        with node.sdo.open(0x1008, mode=mode, block_transfer=True) as name:
            assert name.read() == expected
    for delta, how in [(7, {"block_transfer": True}), (8, {"force_segment": True})]:
        written = delta.to_bytes(4, "little")
        with node.sdo.open(0x6426, 1, mode="wb", size=4, **how) as stream:
            stream.write(written)
        with node.sdo.open(0x6426, 1, block_transfer=True) as stream:
            assert stream.read() == written
    with pytest.raises(canopen.SdoAbortedError, match=f"0x{READ_ONLY}"):
        node.sdo.open(0x1008, mode="wb", size=9, block_transfer=True)


def test_pdos_carry_the_button_the_temperature_and_the_leds(boards, node):
    node.tpdo.read()
    node.rpdo.read()
    mapped = {
        pdo.cob_id: [(variable.index, variable.subindex, variable.length) for variable in pdo]
        for pdo in [*node.tpdo.values(), *node.rpdo.values()]
        if pdo.enabled
    }
    assert mapped == {0x185: [(0x6000, 1, 8)], 0x285: [(0x6401, 1, 16)], 0x205: [(0x6200, 1, 8)]}
    button, temperature = Reception(node.tpdo[1]), Reception(node.tpdo[2])
    set_state(node, "OPERATIONAL", OPERATIONAL)

    boards.command("button down")
    button.wait_until(lambda values: values == [1])
    boards.command("button up")
    button.wait_until(lambda values: values == [0])
    boards.command("temperature 40")
    # In 0.1 degrees; the converter and the delta leave it 1 degree off at most.
    temperature.wait_until(lambda values: 390 <= values[0] <= 410)
    boards.command("temperature -20")
    temperature.wait_until(lambda values: -210 <= values[0] <= -190)

    leds = node.rpdo[1]["Write output 8-bit.LEDs"]
    for outputs, line in [
        (1, "board 0: LED 1 on, LED 2 off"),
        (2, "board 0: LED 1 off, LED 2 on"),
        (0, "board 0: LED 1 off, LED 2 off"),
    ]:
        leds.raw = outputs
        node.rpdo[1].transmit()
        boards.wait_for_line(line, PATIENCE)
        assert node.sdo[0x6200][1].raw == outputs


def test_a_master_maps_the_temperature_into_a_tpdo_and_asks_for_it_by_sync(boards, network, node):
    node.tpdo.read()
    both = node.tpdo[1]
    both.add_variable(0x6401, 1)
    both.trans_type = 1
    both.save()
    node.tpdo[2].enabled = False
    node.tpdo[2].save()
    assert node.sdo[0x1800][2].raw == 1
    assert [node.sdo[0x1A00][number].raw for number in range(3)] == [2, 0x6000_0108, 0x6401_0110]
    node.sdo[0x1A01][0].raw = 0
    assert_refused(NOT_MAPPABLE, node.sdo.download, 0x1A01, 1, bytes.fromhex("08000021"))

    reception = Reception(both)
    set_state(node, "OPERATIONAL", OPERATIONAL)
    boards.command("button down")
    deadline = time.monotonic() + PATIENCE
    while node.sdo[0x6000][1].raw != 1:
        assert time.monotonic() < deadline, "the button is not read"
    assert reception.received.empty(), "there was no SYNC"
    for _ in range(5):
        network.sync.transmit()
        is_pressed, temperature = reception.next()
        assert is_pressed == 1 and 200 <= temperature <= 300
    network.sync.start(0.05)
    for _ in range(20):
        reception.next()
    network.sync.stop()
    node.sdo[0x6000][1].raw  # What is still under way comes before the answer.
    while not reception.received.empty():
        reception.next()
    node.sdo[0x6000][1].raw
    assert reception.received.empty(), "the SYNC has ended"


def test_the_loss_of_the_masters_heartbeat_is_an_emergency(network, node):
    consumer_time = 2000
    node.sdo["Consumer heartbeat time"][1].raw = MASTER << 16 | consumer_time
    master = network.create_node(MASTER, EDS)
    master.nmt.start_heartbeat(consumer_time // 10)
    set_state(node, "OPERATIONAL", OPERATIONAL)
    time.sleep(2 * consumer_time / 1000)
    assert node.sdo[0x1001].raw == 0 and not node.emcy.log, "the heartbeat is there"

    states = States(node)
    master.nmt.stop_heartbeat()
    emergency = wait_for_emergency(node, HEARTBEAT_LOST)
    assert emergency.register == 0x11
    states.wait_for(PRE_OPERATIONAL)
    assert node.sdo[0x1003][1].raw & 0xFFFF == HEARTBEAT_LOST

    master.nmt.start_heartbeat(consumer_time // 10)
    wait_for_emergency(node, NO_ERROR)
    assert not node.emcy.active
    assert node.sdo[0x1001].raw == 0
    set_state(node, "OPERATIONAL", OPERATIONAL)
    master.nmt.stop_heartbeat()
