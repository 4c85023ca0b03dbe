/**
 * The npm package canopen, unmodified, installs an update file on a node with a loader:
 * update.js PORT NODE-ID EDS FILE.
 */

const assert = require('assert/strict');
const { once } = require('events');
const fs = require('fs');
const { setTimeout: wait } = require('timers/promises');
const { Device, DataType, Eds } = require('canopen');
const { SlcanBus } = require('./slcan');

const [port, nodeId, edsPath, path] = process.argv.slice(2);
const NODE_ID = Number(nodeId);
/** Milliseconds to wait for an answer, and for a whole download, on a computer that is busy. */
const PATIENCE = 20_000, DOWNLOAD = 120_000;

/** The data sheet for this node: the package takes `$NODEID+0x600` for 0. */
function sheetOfNode() {
    const eds = Eds.fromFile(edsPath);
    eds.getSubEntry(0x1200, 1).value = 0x600 + NODE_ID;
    eds.getSubEntry(0x1200, 2).value = 0x580 + NODE_ID;
    eds.getEntry(0x1014).value = 0x80 + NODE_ID;
    return eds;
}

const bus = new SlcanBus(Number(port), 125);
const device = new Device({ id: 127 });
device.addListener('message', (frame) => bus.send(frame));
bus.addListener('message', (frame) => device.receive(frame));
device.mapRemoteNode({ id: NODE_ID, eds: sheetOfNode() });
device.start();

const address = (index, timeout) => ({ deviceId: NODE_ID, index, subIndex: 1, timeout });
const read = (index, dataType) => device.sdo.upload({ ...address(index, PATIENCE), dataType });
const control = (data) =>
    device.sdo.download({ ...address(0x1F51, PATIENCE), data, dataType: DataType.UNSIGNED8 });

/** Waits while the loader is busy. */
async function ready() {
    let status = 1;
    while ((status = await read(0x1F57, DataType.UNSIGNED32)) & 1) await wait(100);
    assert.equal(status, 0);
}

async function main() {
    await once(bus.socket, 'connect');
    const data = fs.readFileSync(path);
    device.nmt.enterPreOperational(NODE_ID);
    await control(0);
    await control(3);
    await ready();
    const options = { data, dataType: DataType.DOMAIN, blockTransfer: true };
    await device.sdo.download({ ...address(0x1F50, DOWNLOAD), ...options });
    await ready();
    await control(1);
    await wait(1000);
    assert.equal(await read(0x1F56, DataType.UNSIGNED32), data.readUInt32LE(12));
    await control(0x80);
    device.stop();
    bus.close();
}

main().catch((error) => {
    console.error(error);
    process.exit(1);
});
