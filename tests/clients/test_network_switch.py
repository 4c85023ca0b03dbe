"""python-canopen switches a network from bit rate to bit rate, and closes and opens its bus in between.

Nothing is tried again. The time-outs are python-canopen's own: 0.5 s for LSS, 0.3 s for SDO.
With `./run -s -k switch` the tests print how late python-canopen was, and how soon all had answered.
"""

import re
import time

import pytest
from canopen import lss

from boards import EDS, Boards
from test_python_canopen import PRODUCT_CODE, REVISION_NUMBER
from test_rescue import bit_rates_and_rescues

TABLE_INDEX = {1_000_000: 0, 500_000: 2, 125_000: 4}
NODE_IDS = 1, 2, 3
ERROR_PASSIVE = 0x8120
# In seconds. Twice this is more than the 1.3 s that python-canopen may take to close its bus.
DELAY = 0.7


class Network:
    """Three boards, and the python-canopen network that follows them."""

    def __init__(self, boards):
        self.boards = boards
        self.bit_rate = 125_000
        self.network = boards.connect(self.bit_rate)
        self.nodes = [self.network.add_node(node_id, EDS) for node_id in NODE_IDS]

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.network.disconnect()

    def request_switch(self, bit_rate):
        """Switches all boards to the bit rate, and returns when they take part at it."""
        master = self.network.lss
        master.send_switch_state_global(master.CONFIGURATION_STATE)
        master.configure_bit_timing(TABLE_INDEX[bit_rate])
        master.activate_bit_timing(int(DELAY * 1000))
        return time.monotonic() + 2 * DELAY

    def follow(self, bit_rate, switched, late):
        """Opens the bus at the bit rate a number of seconds late, and asks every board."""
        self.network.disconnect()
        time.sleep(max(0, switched + late - time.monotonic()))
        print(f"{self.bit_rate // 1000} -> {bit_rate // 1000} kbit/s,", end=" ")
        self.bit_rate = bit_rate
        connected = time.monotonic()
        self.boards.connect(bit_rate, self.network)
        print(f"opened {connected - switched:.2f} s late:", end=" ")
        self.ask_all()
        print(f"all had answered {time.monotonic() - connected:.2f} s later")

    def ask_all(self):
        """Asks all by LSS and each by SDO: no board has looked for another bit rate."""
        master = self.network.lss
        assert master.inquire_lss_address(lss.CS_INQUIRE_PRODUCT_CODE) == PRODUCT_CODE
        master.send_switch_state_global(master.WAITING_STATE)
        for node in self.nodes:
            kbit_per_s = self.bit_rate // 1000
            assert bit_rates_and_rescues(node) == (kbit_per_s, kbit_per_s, 0), f"node {node.id}"

    def ask_one(self, node_id):
        """Selects one board by its LSS address, and asks for its node-ID."""
        master = self.network.lss
        serial_number = self.boards.serial_numbers[NODE_IDS.index(node_id)]
        assert master.send_switch_state_selective(0, PRODUCT_CODE, REVISION_NUMBER, serial_number)
        assert master.inquire_node_id() == node_id
        master.send_switch_state_global(master.WAITING_STATE)


@pytest.fixture
def network():
    with Boards("--boards", len(NODE_IDS), "--node-id", NODE_IDS[0]) as boards:
        with Network(boards) as network:
            yield network


# The master's delay at each step of a round in seconds; 20 s occur only once.
ROUNDS = [(0.1, 1, 5), (5, 0.1, 1), (1, 20, 0.1)]


def test_a_master_that_follows_late_reaches_all_at_once(network):
    for node_id, lateness in zip(NODE_IDS, ROUNDS):
        for bit_rate, late in zip([500_000, 1_000_000, 125_000], lateness):
            switched = network.request_switch(bit_rate)
            network.follow(bit_rate, switched, late)
        network.ask_one(node_id)


@pytest.mark.parametrize("heartbeat", [1000, 0])
def test_a_master_that_syncs_at_the_old_rate_loses_nobody(network, heartbeat):
    for node in network.nodes:
        node.sdo["Producer heartbeat time"].raw = heartbeat
    for bit_rate in 500_000, 125_000:
        switched = network.request_switch(bit_rate)
        network.network.sync.start(0.1)
        time.sleep(max(0, switched + 3 - time.monotonic()))
        network.network.sync.stop()
        network.follow(bit_rate, switched, late=3)
    # The history takes an error when its message has left, which waits for the error counters to fall.
    time.sleep(1)
    for node in network.nodes:
        history = node.sdo["Pre-defined error field"]
        errors = [history[number].raw for number in range(1, history[0].raw + 1)]
        print(f"node {node.id}:", *(f"{error:08X}" for error in errors))
        assert ERROR_PASSIVE in errors, "the SYNC has disturbed no board"


def test_the_script_moves_a_network_for_good(tmp_path):
    arguments = "--boards", len(NODE_IDS), "--node-id", NODE_IDS[0], "--flash", tmp_path
    with Boards(*arguments) as boards:
        code, printed, complaints = boards.run_script("switch_bit_rate.py", 125, 500, *NODE_IDS)
        assert code == 0, complaints
        said = re.findall(r"node (\d+) at 500 kbit/s: serial number (\w{8})", printed)
        assert [int(node_id) for node_id, _ in said] == list(NODE_IDS)
        assert [int(number, 16) for _, number in said] == boards.serial_numbers

    with Boards(*arguments) as boards:
        assert boards.description.count("500 kbit/s") == len(NODE_IDS)


def test_the_script_says_that_no_board_answers():
    with Boards("--node-id", 1, "--console") as boards:
        boards.command("power off 0")
        code, printed, complaints = boards.run_script("switch_bit_rate.py", 250, 500, 1)
        assert (code, printed) == (1, "")
        assert complaints.endswith("LssError: No LSS response received\n")
