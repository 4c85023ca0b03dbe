"""Tests the example with inputs and outputs (`src/io.rs`) with python-canopen, unmodified, and its data sheet."""

import queue
import time

import canopen
import pytest
from canopen.objectdictionary import datatypes

from boards import WORKSPACE, Boards
from test_python_canopen import BOOT_UP, OPERATIONAL, PATIENCE, PRE_OPERATIONAL, States, connect
from test_rescue import NO_ERROR, wait_for_emergency

EDS = str(WORKSPACE / "eds" / "io.eds")
# With a second board the first is never alone on the bus, which would make it error passive.
EXAMPLE = "--example", "io", "--chip", "stm32f407", "--boards", 2
NODE_ID, MASTER = 5, 127
HEARTBEAT_LOST = 0x8130
# Abort codes of SDO.
READ_ONLY, NOT_MAPPABLE = "06010002", "06040041"
TOO_LONG, TOO_HIGH, NO_DATA = "06070012", "06090031", "08000024"
# The temperature is measured: it has not kept its default.
MEASURED = 0x6401, 1
SIZES = {
    datatypes.UNSIGNED8: 1,
    datatypes.INTEGER16: 2,
    datatypes.UNSIGNED16: 2,
    datatypes.UNSIGNED32: 4,
    datatypes.REAL32: 4,
    datatypes.INTEGER64: 8,
}


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


def add_node(network, eds=EDS):
    node = network.add_node(NODE_ID, eds)
    node.sdo.RESPONSE_TIMEOUT = PATIENCE
    return node


def variables(node):
    for entry in node.object_dictionary.values():
        yield from entry.values() if hasattr(entry, "values") else [entry]


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
    return add_node(network, canopen.import_od(EDS, NODE_ID))


def assert_refused(code, transfer, *arguments):
    with pytest.raises(canopen.SdoAbortedError, match=f"0x{code}"):
        transfer(*arguments)


def test_lss_commissions_the_example_and_its_values_survive_a_power_cycle(tmp_path):
    arguments = *EXAMPLE, "--flash", tmp_path
    with Boards(*arguments) as boards, connect(boards) as network:
        assert boards.description.count("blank") == 2
        master = network.lss
        # The scan recognises a 1 by the absence of an answer, so its time-out determines its speed.
        master.RESPONSE_TIMEOUT = 0.25
        is_found, identity = master.fast_scan()
        master.RESPONSE_TIMEOUT = PATIENCE
        assert is_found and identity[3] in boards.serial_numbers
        node = add_node(network)
        states = States(node)
        master.configure_node_id(NODE_ID)
        master.store_configuration()
        master.send_switch_state_global(master.WAITING_STATE)
        states.wait_for(BOOT_UP)

        node.sdo["Filter constant of the temperature"].raw = 6
        node.sdo[0x6426][1].raw = 20
        node.sdo[0x1017].raw = 250
        node.store()
        node.sdo[0x6426][1].raw = 30

    with Boards(*arguments) as boards, connect(boards) as network:
        assert boards.description.count("blank") == 1
        node = add_node(network)
        assert node.sdo[0x1018][4].raw == identity[3]
        assert parameters(node) == (6, 20, 250)
        node.restore()
        states = States(node)
        node.nmt.state = "RESET"
        states.wait_for(PRE_OPERATIONAL)
        assert parameters(node) == (3, 5, 1000), "the defaults"


def parameters(node):
    """The stored values: filter constant, delta, and time between heartbeats."""
    return node.sdo[0x2100].raw, node.sdo[0x6426][1].raw, node.sdo[0x1017].raw


def test_every_object_of_the_data_sheet_has_its_type_and_default(node):
    compared = 0
    for variable in variables(node):
        if variable.index <= 0x20:
            continue  # A data type.
        name = f"{variable.index:04X}h sub {variable.subindex}, {variable.name}"
        if variable.index == 0x1003 and variable.subindex > 0:
            assert_refused(NO_DATA, node.sdo.upload, variable.index, variable.subindex)
            continue
        if variable.data_type == datatypes.DOMAIN:
            continue  # It takes a minute in segments.
        read = node.sdo.upload(variable.index, variable.subindex)
        if variable.data_type != datatypes.VISIBLE_STRING:
            assert len(read) == SIZES[variable.data_type], name
        if variable.default is not None and (variable.index, variable.subindex) != MEASURED:
            assert variable.decode_raw(read) == variable.default, name
            compared += 1
    assert compared >= 120


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
