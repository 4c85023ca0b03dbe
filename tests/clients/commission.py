"""Gives each blank board on a bus a node-ID: commission.py SLCAN-CHANNEL SECONDS-TO-WAIT-FOR-AN-ANSWER"""
import queue, struct, sys, time
import canopen

CHANNEL, TIMEOUT = sys.argv[1], float(sys.argv[2])
VENDOR_ID, PRODUCT_CODE = 0x0000_0000, 0x4C53_5334

network = canopen.Network().connect(interface="slcan", channel=CHANNEL, bitrate=125000, sleep_after_open=0)
lss = network.lss
lss.RESPONSE_TIMEOUT = 2

def answers(number, bit, part, following, timeout=TIMEOUT):
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
    time.sleep(TIMEOUT)  # An answer that comes too late must not confirm the number.
    return number if answers(number, 0, 3, 0, 2) else None

node_id = 1
while answers(0, 0x80, 0, 0, 2):
    if (serial_number := find_serial_number()) is None:
        print("an answer came too late: scanning again", flush=True)
        continue
    lss.configure_node_id(node_id)
    lss.store_configuration()
    lss.send_switch_state_global(lss.WAITING_STATE)
    print(f"node {node_id}: serial number {serial_number:08X}", flush=True)
    node_id += 1
