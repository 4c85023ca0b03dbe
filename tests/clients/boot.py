"""Boots the nodes of a network as a full master does (CiA 302-2), from the files of dcfgen."""
import argparse, struct, sys, threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
import canopen, dcf

BOOT_UP, PRE_OPERATIONAL = 0x00, 0x7F
STAMP = (0x1020, 1), (0x1020, 2)
# What the master reads from a node, and its own object with the value that it expects.
IDENTITY = {(0x1000, 0): 0x1F84, (0x1018, 1): 0x1F85, (0x1018, 2): 0x1F86, (0x1018, 3): 0x1F87, (0x1018, 4): 0x1F88}


class Refused(Exception):
    """A node is not the one that the configuration describes."""


def concise_dcf(path):
    """The entries of a concise DCF in their order: index, sub-index, and the bytes to write."""
    content = path.read_bytes()
    at = 4
    while at < len(content):
        index, sub_index, length = struct.unpack_from("<HBL", content, at)
        at += 7 + length
        yield index, sub_index, content[at - length : at]


class Configuration:
    """What dcfgen has written into a folder: master.dcf, master.bin, and a concise DCF for each node."""

    def __init__(self, folder):
        master = dcf.Device.from_dcf(str(folder / "master.dcf"))
        written = {entry[:2]: int.from_bytes(entry[2], "little") for entry in concise_dcf(folder / "master.bin")}
        self.nodes = {}
        for node_id, assignment in master[0x1F81].items():
            if node_id and assignment.parse_value() & 1:
                expected = {
                    key: written.get((index, node_id), master[index][node_id].parse_value())
                    for key, index in IDENTITY.items()
                }
                concise = concise_dcf(folder / Path(master[0x1F22][node_id].upload_file).name)
                self.nodes[node_id] = expected, list(concise)


class Slave:
    """One node of the network, from its reset on."""

    def __init__(self, network, node_id, expected, entries):
        self.node = network.add_node(node_id, canopen.ObjectDictionary())
        self.node.sdo.RESPONSE_TIMEOUT = 2
        self.expected, self.entries = expected, entries
        self.has_booted = threading.Event()
        self.node.nmt.add_heartbeat_callback(lambda state: state == BOOT_UP and self.has_booted.set())

    def read(self, index, sub_index):
        return int.from_bytes(self.node.sdo.upload(index, sub_index), "little")

    def boot(self):
        """Checks, configures and starts the node; returns whether its configuration was downloaded."""
        if not self.has_booted.wait(timeout=5):
            raise Refused(f"node {self.node.id} does not boot up")
        for key, expected in self.expected.items():
            if expected and (found := self.read(*key)) != expected:
                raise Refused(f"node {self.node.id}: {key[0]:X}h sub {key[1]} is {found:X}h, not {expected:X}h")
        stamp = {entry[:2]: int.from_bytes(entry[2], "little") for entry in self.entries if entry[:2] in STAMP}
        is_download_needed = not stamp or any(self.read(*key) != value for key, value in stamp.items())
        if is_download_needed:
            for entry in self.entries:
                self.node.sdo.download(*entry)
        self.node.nmt.wait_for_heartbeat(timeout=5)
        self.node.nmt.send_command(0x01)
        return is_download_needed


def boot(network, configuration):
    """Resets and boots all nodes, side by side; returns which have had a download."""
    slaves = {node_id: Slave(network, node_id, *parts) for node_id, parts in configuration.nodes.items()}
    network.nmt.send_command(0x82)
    with ThreadPoolExecutor(len(slaves)) as pool:
        return dict(zip(slaves, pool.map(Slave.boot, slaves.values())))


if __name__ == "__main__":
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("channel", help="of the SLCAN adapter")
    arguments.add_argument("folder", type=Path, help="with the files of dcfgen")
    arguments = arguments.parse_args()
    with canopen.Network() as network:
        network.connect(interface="slcan", channel=arguments.channel, bitrate=125000, sleep_after_open=0)
        try:
            for node_id, is_downloaded in boot(network, Configuration(arguments.folder)).items():
                print(f"node {node_id}: {'configured' if is_downloaded else 'as configured before'}, started")
        except (Refused, canopen.SdoCommunicationError) as error:
            sys.exit(str(error))
