"""Moves all nodes of a bus to another bit rate, and stores it once each of them has answered there."""
import argparse, sys, time
import canopen

TABLE_INDEX = {1000: 0, 500: 2, 250: 3, 125: 4, 50: 6, 20: 7, 10: 8}
SWITCH_DELAY = 1  # second

arguments = argparse.ArgumentParser(description=__doc__)
arguments.add_argument("channel", help="of the SLCAN adapter")
arguments.add_argument("now", type=int, choices=TABLE_INDEX, help="the bit rate of the bus in kbit/s")
arguments.add_argument("then", type=int, choices=TABLE_INDEX, help="the one that it gets")
arguments.add_argument("node_ids", type=int, nargs="+", help="the nodes that are asked", metavar="node_id")
arguments = arguments.parse_args()

def connect(kbit):
    network.connect(interface="slcan", channel=arguments.channel, bitrate=kbit * 1000, sleep_after_open=0)

network = canopen.Network()
lss = network.lss
connect(arguments.now)
lss.send_switch_state_global(lss.CONFIGURATION_STATE)
try:
    lss.configure_bit_timing(TABLE_INDEX[arguments.then])
except canopen.lss.LssError as error:
    lss.send_switch_state_global(lss.WAITING_STATE)
    refused = str(error).startswith("LSS Error")
    sys.exit(f"a board refuses {arguments.then} kbit/s" if refused else f"no board answers at {arguments.now} kbit/s")
lss.activate_bit_timing(SWITCH_DELAY * 1000)
network.disconnect()
time.sleep(3 * SWITCH_DELAY)  # The nodes are silent for twice the delay; to come late does no harm.

connect(arguments.then)
for node_id in arguments.node_ids:
    try:
        serial_number = network.add_node(node_id).sdo.upload(0x1018, 4)
    except canopen.SdoCommunicationError:
        sys.exit(f"node {node_id} is missing: nothing is stored; a power cycle returns all to {arguments.now} kbit/s")
    print(f"node {node_id} at {arguments.then} kbit/s: serial number {int.from_bytes(serial_number, 'little'):08X}")
lss.store_configuration()
lss.send_switch_state_global(lss.WAITING_STATE)
network.disconnect()
