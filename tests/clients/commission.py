"""Gives each board without a node-ID on a bus at 125 kbit/s one that no other node has, and stores it.

    python commission.py CHANNEL [TIMEOUT]

CHANNEL is that of the SLCAN adapter. Each 1 in an LSS address takes TIMEOUT, 0.5 s by default.
"""
import sys, time
import canopen

if len(sys.argv) < 2:
    sys.exit(__doc__)
channel, timeout = sys.argv[1], float((sys.argv[2:] or ["0.5"])[0])
network = canopen.Network().connect(interface="slcan", channel=channel, bitrate=125000, sleep_after_open=0)
network.scanner.search()                                         # asks each node-ID by SDO
time.sleep(1)

def find():
    """The LSS address of a board without a node-ID, which is in LSS configuration state then; or None."""
    network.lss.RESPONSE_TIMEOUT = timeout
    scans = (network.lss.fast_scan() for _ in range(3))          # an answer that comes too late spoils a scan
    return next((address for is_found, address in scans if is_found), None)

count = 0
while (address := find()) is not None:
    node_id = min(set(range(1, 128)) - set(network.scanner.nodes))
    network.lss.RESPONSE_TIMEOUT = 2                             # a store takes longer
    network.lss.configure_node_id(node_id)
    network.lss.store_configuration()
    network.lss.send_switch_state_global(network.lss.WAITING_STATE)  # it boots up as this node
    print(f"node {node_id}: serial number {address[3]:08X}", flush=True)
    network.scanner.nodes.append(node_id)
    count += 1
print(f"{count} boards have got a node-ID")
