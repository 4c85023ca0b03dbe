"""Gives each blank board on a bus at 125 kbit/s a node-ID that no other node has, and stores it."""
import argparse, queue, struct, sys, time
import canopen

VENDOR_ID, PRODUCT_CODE = 0x0000_0000, 0x4C53_5334

arguments = argparse.ArgumentParser(description=__doc__)
arguments.add_argument("channel", help="of the SLCAN adapter")
arguments.add_argument("timeout", type=float, help="the time to wait for an answer, in seconds")
arguments = arguments.parse_args()

network = canopen.Network().connect(interface="slcan", channel=arguments.channel, bitrate=125000, sleep_after_open=0)
lss = network.lss
lss.RESPONSE_TIMEOUT = 2

def answers(number, bit, part, following, timeout=arguments.timeout):
    """Whether a blank board's identity has, in `part` (0 vendor .. 3 serial), the bits of `number` from `bit` up."""
    lss.responses = queue.Queue()
    network.send_message(lss.LSS_TX_COBID, struct.pack("<BIBBB", 0x51, number, bit, part, following))
    try:
        return lss.responses.get(timeout=timeout)[0] == 0x4F
    except queue.Empty:
        return False

def find_serial_number():
    """Fastscan with the known parts of the identity; the board found is then in configuration state."""
    if not (answers(VENDOR_ID, 0, 0, 1, 2) and answers(PRODUCT_CODE, 0, 1, 3, 2)):
        sys.exit("the blank boards have another vendor-ID or product code")
    number = 0
    for bit in reversed(range(32)):
        number |= 0 if answers(number, bit, 3, 3) else 1 << bit
    time.sleep(arguments.timeout)  # An answer that comes too late must not confirm the number.
    return number if answers(number, 0, 3, 0, 2) else None

def is_free(node_id):
    """Whether no node sends with the node-ID, neither an answer for its object 1000h nor of its own accord."""
    network.send_message(0x600 + node_id, struct.pack("<BHBI", 0x40, 0x1000, 0, 0))
    time.sleep(arguments.timeout)
    return node_id not in network.scanner.nodes

free_node_ids = filter(is_free, range(1, 128))
node_id = None
while answers(0, 0x80, 0, 0, 2):
    if (serial_number := find_serial_number()) is None:
        print("an answer came too late: scanning again", flush=True)
        continue
    if (node_id := next(free_node_ids, None)) is None:
        lss.send_switch_state_global(lss.WAITING_STATE)
        sys.exit("no node-ID is free")
    lss.configure_node_id(node_id)
    lss.store_configuration()
    lss.send_switch_state_global(lss.WAITING_STATE)
    print(f"node {node_id}: serial number {serial_number:08X}", flush=True)
if node_id is None:
    print("no blank board")
