#!/usr/bin/python3
"""The session with python-canopen on python-can's interface socketcan; `ip link` sets the bit rate.

Boards 2 and 3 get node-IDs and a bit rate, all switch to it, and the power fails. The environment variable
`serial_numbers` has those of all boards, from the kernel's command line.
"""

import os
import queue
import subprocess
import time

import canopen
from canopen import lss

VENDOR_ID, PRODUCT_CODE, REVISION_NUMBER = 0x0000_0000, 0x4C53_5334, 0x0001_0000
BOOT_UP, OPERATIONAL, PRE_OPERATIONAL = 0x00, 0x05, 0x7F
SWITCH_DELAY = 1  # second
# Much longer than necessary, for a busy computer.
PATIENCE = 10

BOARDS, NODE_IDS = (2, 3), (5, 6)
SERIAL_NUMBERS = [int(number, 16) for number in os.environ["serial_numbers"].split()[2:4]]


def host(command):
    """Lets the host carry out a command of `cargo emulate --console`."""
    print("host:", command, flush=True)
    input()


class Network(canopen.Network):
    """The bus on slcan0 with its nodes, and the NMT states that they report."""

    def __init__(self):
        super().__init__()
        self.connect(interface="socketcan", channel="slcan0")
        self.lss.RESPONSE_TIMEOUT = PATIENCE
        self.states = {}
        for node_id in NODE_IDS:
            node = self.add_node(node_id, "/lss-slave.eds")
            node.sdo.RESPONSE_TIMEOUT = PATIENCE
            self.states[node_id] = queue.Queue()
            node.nmt.add_heartbeat_callback(self.states[node_id].put)

    def wait_for(self, node_id, state):
        deadline = time.monotonic() + PATIENCE
        while self.states[node_id].get(timeout=max(0, deadline - time.monotonic())) != state:
            pass

    def commission(self, node_id, serial_number):
        master = self.lss
        identity = VENDOR_ID, PRODUCT_CODE, REVISION_NUMBER, serial_number
        assert master.send_switch_state_selective(*identity)
        asked = [lss.CS_INQUIRE_VENDOR_ID, lss.CS_INQUIRE_PRODUCT_CODE]
        asked += [lss.CS_INQUIRE_REVISION_NUMBER, lss.CS_INQUIRE_SERIAL_NUMBER]
        assert tuple(map(master.inquire_lss_address, asked)) == identity
        assert master.inquire_node_id() == 0xFF
        master.configure_node_id(node_id)
        master.configure_bit_timing(2)
        master.store_configuration()
        master.send_switch_state_global(master.WAITING_STATE)
        self.wait_for(node_id, BOOT_UP)

    def check_identities(self):
        for node_id, serial_number in zip(NODE_IDS, SERIAL_NUMBERS):
            assert self[node_id].sdo[0x1018][4].raw == serial_number
            assert self[node_id].sdo[0x1008].raw == "LSS slave"


def say(text):
    print("python-canopen:", text, flush=True)


def set_bit_rate(bit_rate):
    subprocess.run(["ip", "link", "set", "slcan0", "down"], check=True)
    subprocess.run(f"ip link set slcan0 up type can bitrate {bit_rate}".split(), check=True)


def session():
    say("two other boards, blank; each is selected, and gets a node-ID and 500 kbit/s")
    for board in 0, 1:
        host(f"power off {board}")
    for board in BOARDS:
        host(f"power on {board}")
    set_bit_rate(125_000)
    with Network() as network:
        for node_id, serial_number in zip(NODE_IDS, SERIAL_NUMBERS):
            network.commission(node_id, serial_number)
        network.check_identities()

        say("all switch to 500 kbit/s; `ip link` sets the bit rate")
        network.lss.send_switch_state_global(network.lss.CONFIGURATION_STATE)
        network.lss.activate_bit_timing(SWITCH_DELAY * 1000)
        time.sleep(0.5)  # The frame may still be on the serial line.
    set_bit_rate(500_000)
    time.sleep(2 * SWITCH_DELAY)
    with Network() as network:
        network.check_identities()
        network.lss.send_switch_state_global(network.lss.WAITING_STATE)
        network.nmt.state = "OPERATIONAL"
        for node_id in NODE_IDS:
            network.wait_for(node_id, OPERATIONAL)

        say("the power fails; node-IDs and bit rate were stored")
        for board in BOARDS:
            host(f"power off {board}")
        time.sleep(1)
        for board, node_id in zip(BOARDS, NODE_IDS):
            host(f"power on {board}")
            network.wait_for(node_id, BOOT_UP)
            network.wait_for(node_id, PRE_OPERATIONAL)
        network.check_identities()


with subprocess.Popen(["candump", "-L", "any"]) as candump:
    try:
        session()
    finally:
        candump.kill()
