"""Installs an update file on nodes with a loader: clears all, downloads one by one, starts and confirms.

    python update.py CHANNEL KBIT FILE NODE_ID...
"""
import sys, time
import canopen

if len(sys.argv) < 5:
    sys.exit(__doc__)
channel, kbit, path, *node_ids = sys.argv[1:]
file = open(path, "rb").read()
crc = int.from_bytes(file[12:16], "little")
network = canopen.Network()
network.connect(interface="slcan", channel=channel, bitrate=int(kbit) * 1000, sleep_after_open=0)
nodes = [network.add_node(int(node_id)) for node_id in node_ids]

def number(node, index):
    return int.from_bytes(node.sdo.upload(index, 1), "little")

def control(node, value):
    node.sdo.download(0x1F51, 1, bytes([value]))

def wait(node):
    while (status := number(node, 0x1F57)) & 1:         # busy
        time.sleep(0.1)
    if status:
        sys.exit(f"node {node.id}: status {status >> 1 & 0x7F}, byte {status >> 16} of the header")

for node in nodes:
    node.sdo.RESPONSE_TIMEOUT = 2
    node.nmt.send_command(0x80)
    control(node, 0)                                    # the loader answers
    try:
        node.sdo.download(0x1F50, 1, file[:512])        # and says whether the header fits: a signed one wants it so
    except canopen.SdoAbortedError as error:
        if error.code != 0x08000022:                    # it does, but nothing is cleared
            sys.exit(f"node {node.id}: refused, byte {number(node, 0x1F57) >> 16} of the header")
for node in nodes:
    control(node, 3)                                    # they clear at the same time
asked = time.monotonic()
for node in nodes:
    if time.monotonic() > asked + 20:                   # a loader that nobody asks for 60 s goes back
        asked = time.monotonic()
        for other in nodes:
            number(other, 0x1F57)
    wait(node)
    with node.sdo.open(0x1F50, 1, "wb", size=len(file), block_transfer=True) as program:
        program.write(file)
    wait(node)
    control(node, 1)
    node.nmt.wait_for_bootup(10)
    if number(node, 0x1F56) != crc:
        sys.exit(f"node {node.id}: the program before runs")
    control(node, 0x80)
    print(f"node {node.id}: {node.sdo.upload(0x100A, 0).decode()}, confirmed")
network.disconnect()
