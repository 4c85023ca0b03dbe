/**
 * The npm package canopen, unmodified, uses the example with inputs and outputs: example.js PORT NODE-ID EDS. It prints
 * the commands that the example has to get.
 */

const assert = require('assert/strict');
const { once } = require('events');
const { Device, DataType, Eds, NmtState, SdoError } = require('canopen');
const { SlcanBus } = require('./slcan');

const [port, nodeId, edsPath] = process.argv.slice(2);
const NODE_ID = Number(nodeId);
/** Milliseconds to wait for an answer, far beyond what is due, for a computer that is busy. */
const PATIENCE = 20_000;
const BUTTON = 0x180 + NODE_ID, TEMPERATURE = 0x280 + NODE_ID, LEDS = 0x200 + NODE_ID;

/** The data sheet for this node: the package takes `$NODEID+0x180` for 0. */
function sheetOfNode() {
    const eds = Eds.fromFile(edsPath);
    for (const [index, subIndex, cobId] of [
        [0x1200, 1, 0x600], [0x1200, 2, 0x580], [0x1400, 1, 0x200], [0x1800, 1, 0x180], [0x1801, 1, 0x280],
    ])
        eds.getSubEntry(index, subIndex).value = cobId + NODE_ID;
    for (const index of [0x1401, 0x1402, 0x1403, 0x1802, 0x1803])
        eds.getSubEntry(index, 1).value = 0x80000000; // Not valid.
    eds.getEntry(0x1014).value = 0x80 + NODE_ID;
    return eds;
}

const bus = new SlcanBus(Number(port), 125);
const eds = sheetOfNode();
const device = new Device({ id: 127 });
device.addListener('message', (frame) => bus.send(frame));
bus.addListener('message', (frame) => device.receive(frame));
device.mapRemoteNode({ id: NODE_ID, eds });
device.eds.addEntry(0x6200, { parameterName: 'LEDs', dataType: DataType.UNSIGNED8 });
device.eds.addTransmitPdo({ cobId: LEDS, transmissionType: 255, dataObjects: [device.eds.getEntry(0x6200)] });
device.start();

/** Waits for a PDO whose first value is as expected; `event` is what makes the node send it. */
async function received(cobId, isExpected, event) {
    const signal = AbortSignal.timeout(PATIENCE);
    const expected = new Promise((resolve, reject) => {
        const listener = (pdo) => {
            if (pdo.cobId === cobId && isExpected(pdo.dataObjects[0].value)) {
                device.pdo.removeListener('pdo', listener);
                resolve();
            }
        };
        device.pdo.addListener('pdo', listener);
        signal.addEventListener('abort', () => reject(new Error(`no PDO ${cobId.toString(16)} after ${event}`)));
    });
    console.log(event);
    await expected;
}

async function main() {
    await once(bus.socket, 'connect');
    const address = (index, subIndex) => ({ deviceId: NODE_ID, index, subIndex, timeout: PATIENCE });
    const read = (index, subIndex, dataType, more) =>
        device.sdo.upload({ ...address(index, subIndex), dataType, ...more });
    const write = (index, subIndex, data, dataType, more) =>
        device.sdo.download({ ...address(index, subIndex), data, dataType, ...more });

    assert.equal(await read(0x2100, 0, DataType.UNSIGNED8), Number(eds.getEntry(0x2100).defaultValue));
    await write(0x2100, 0, 0, DataType.UNSIGNED8);
    await assert.rejects(
        write(0x2100, 0, eds.getEntry(0x2100).highLimit + 1, DataType.UNSIGNED8),
        (error) => error instanceof SdoError && error.code === 0x06090031,
    );
    const byBlocks = { blockTransfer: true };
    assert.equal(await read(0x1008, 0, DataType.VISIBLE_STRING, byBlocks), eds.getDeviceName());

    device.nmt.setState(NmtState.OPERATIONAL);
    device.nmt.startNode(NODE_ID);
    await received(BUTTON, (pressed) => pressed === 1, 'button down');
    await received(BUTTON, (pressed) => pressed === 0, 'button up');
    await received(TEMPERATURE, (value) => Math.abs(value - 400) <= 10, 'temperature 40');
    await received(TEMPERATURE, (value) => Math.abs(value + 200) <= 10, 'temperature -20');

    device.eds.getEntry(0x6200).value = 3;
    device.pdo.write(LEDS);
    assert.equal(await read(0x6200, 1, DataType.UNSIGNED8), 3);
    device.stop();
    bus.close();
}

main().catch((error) => {
    console.error(error);
    process.exit(1);
});
