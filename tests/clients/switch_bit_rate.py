"""Moves all nodes of a bus to another bit rate, and stores it once each of them has answered there.

    python switch_bit_rate.py CHANNEL FROM TO NODE_ID...

CHANNEL is that of the SLCAN adapter; the bit rates are in kbit/s.
"""
import sys, time
import canopen

if len(sys.argv) < 5:
    sys.exit(__doc__)
TABLE_INDEX = {1000: 0, 500: 2, 250: 3, 125: 4, 50: 6, 20: 7, 10: 8}

channel, (now, then, *node_ids) = sys.argv[1], map(int, sys.argv[2:])
network = canopen.Network()

def connect(kbit):
    network.connect(interface="slcan", channel=channel, bitrate=kbit * 1000, sleep_after_open=0)

connect(now)
network.lss.send_switch_state_global(network.lss.CONFIGURATION_STATE)
network.lss.configure_bit_timing(TABLE_INDEX[then])
network.lss.activate_bit_timing(1000)                   # ms until the nodes switch; then they are silent as long again
network.disconnect()
time.sleep(3)                                           # to come late does no harm

connect(then)
for node_id in node_ids:                                # without an answer it ends here: a power cycle undoes the switch
    serial_number = int.from_bytes(network.add_node(node_id).sdo.upload(0x1018, 4), "little")
    print(f"node {node_id} at {then} kbit/s: serial number {serial_number:08X}")
network.lss.store_configuration()
network.lss.send_switch_state_global(network.lss.WAITING_STATE)
network.disconnect()
