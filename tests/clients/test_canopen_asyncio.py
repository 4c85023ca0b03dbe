"""Tests the release firmware with canopen-asyncio, unmodified: LSS, and SDO while other tasks run."""

import asyncio

import canopen_asyncio as canopen
from canopen_asyncio.objectdictionary.eds import import_eds

from boards import EDS, Boards
from test_python_canopen import BOOT_UP, PATIENCE, identity

NODE_ID = 42


async def session(boards):
    loop = asyncio.get_running_loop()
    async with canopen.Network(loop=loop) as network:
        network.connect(interface="slcan", channel=boards.channel, bitrate=125_000, sleep_after_open=0)
        master = network.lss
        # The scan recognises a 1 by the absence of an answer, so its time-out determines its speed.
        master.RESPONSE_TIMEOUT = 0.25
        assert await master.afast_scan() == (True, list(identity(boards)))
        master.RESPONSE_TIMEOUT = PATIENCE
        # The package has no asynchronous form of its other LSS services.
        assert await asyncio.to_thread(master.inquire_node_id) == 0xFF
        await asyncio.to_thread(master.configure_node_id, NODE_ID)
        await asyncio.to_thread(master.store_configuration)

        # Given the file itself, the package would read it with python-canopen, and not find the entries by their names.
        node = await network.aadd_node(NODE_ID, import_eds(EDS, NODE_ID))
        node.sdo.RESPONSE_TIMEOUT = PATIENCE
        has_booted = asyncio.Event()
        node.nmt.add_heartbeat_callback(lambda state: state == BOOT_UP and has_booted.set())
        await asyncio.to_thread(master.send_switch_state_global, master.WAITING_STATE)
        await asyncio.wait_for(has_booted.wait(), PATIENCE)
        names = "Manufacturer device name", "Producer heartbeat time"
        assert await asyncio.gather(*(node.sdo[name].aget_raw() for name in names)) == ["LSS slave", 1000]
        serial_number = await node.sdo["Identity object"]["Serial number"].aget_raw()
        assert serial_number == boards.serial_numbers[0]


def test_canopen_asyncio_finds_a_blank_board_and_lss_configures_it(tmp_path):
    with Boards("--flash", tmp_path) as boards:
        asyncio.run(session(boards))
    with Boards("--flash", tmp_path) as boards:
        assert f"node-ID {NODE_ID}, 125 kbit/s" in boards.description
