/** The npm package canopen, unmodified, commissions and uses a blank board: session.js PORT SERIAL-NUMBER EDS. */

const assert = require('assert/strict');
const { once } = require('events');
const { Device, DataType, Eds, LssError, LssMode, NmtState, SdoError } = require('canopen');
const { SlcanBus } = require('./slcan');

const [port, serialNumber, edsPath] = process.argv.slice(2);
const KNOWN = { vendorId: 0x00000000, productCode: 0x4c535334, revisionNumber: 0x00010000 };
const IDENTITY = { ...KNOWN, serialNumber: parseInt(serialNumber, 16) };
const NODE_ID = 9;
/** Milliseconds to wait for an answer, far beyond what is due, for a computer that is busy. */
const PATIENCE = 20_000;

const bus = new SlcanBus(Number(port), 125);
const device = new Device({ id: 127, enableLss: true });
device.addListener('message', (frame) => bus.send(frame));
bus.addListener('message', (frame) => device.receive(frame));
device.eds.addSdoClientParameter(NODE_ID, 0x600 + NODE_ID, 0x580 + NODE_ID);
device.eds.addHeartbeatConsumer(NODE_ID, PATIENCE);
device.start();

/** Waits until the board's boot-up or heartbeat says this state. */
async function reported(state) {
    for (;;) {
        const [heartbeat] = await once(device.nmt, 'heartbeat', { signal: AbortSignal.timeout(PATIENCE) });
        if (heartbeat.state === state)
            return;
    }
}

/** Calls a service that is refused by the board itself: not by silence. */
async function isRefused(service, type, code) {
    await assert.rejects(service, (error) => error instanceof type && error.code === code);
}

async function configure({ lss }) {
    // Fastscan recognises a 1 by the absence of an answer, and skips the known parts.
    assert.deepEqual(await lss.fastscan({ ...KNOWN, timeout: 250 }), IDENTITY);
    lss.switchModeGlobal(LssMode.OPERATION);
    assert.deepEqual(await lss.fastscan({ timeout: 250 }), IDENTITY);
    lss.switchModeGlobal(LssMode.OPERATION);
    await lss.switchModeSelective({ ...IDENTITY, timeout: PATIENCE });

    assert.equal(await lss.inquireVendorId(PATIENCE), IDENTITY.vendorId);
    assert.equal(await lss.inquireProductCode(PATIENCE), IDENTITY.productCode);
    assert.equal(await lss.inquireRevisionNumber(PATIENCE), IDENTITY.revisionNumber);
    assert.equal(await lss.inquireSerialNumber(PATIENCE), IDENTITY.serialNumber);
    await isRefused(lss.configureNodeId(128, PATIENCE), LssError, 1);
    await isRefused(lss.configureBitTiming(0, 5, PATIENCE), LssError, 1);
    await lss.configureBitTiming(0, 4, PATIENCE);
    await lss.configureNodeId(NODE_ID, PATIENCE);
    await lss.storeConfiguration(PATIENCE);

    const booted = reported(NmtState.INITIALIZING);
    lss.switchModeGlobal(LssMode.OPERATION);
    await booted;
    await reported(NmtState.PRE_OPERATIONAL);
    assert.equal(await lss.fastscan({ timeout: 1000 }), null);
}

async function operate({ nmt, sdo }) {
    const address = (index, subIndex) => ({ deviceId: NODE_ID, index, subIndex, timeout: PATIENCE });
    const read = (index, subIndex, dataType) => sdo.upload({ ...address(index, subIndex), dataType });
    const write = (index, subIndex, data, dataType) =>
        sdo.download({ ...address(index, subIndex), data, dataType });

    const eds = Eds.fromFile(edsPath);
    assert.equal(eds.lssSupported, true);
    // A segmented transfer.
    assert.equal(await read(0x1008, 0, DataType.VISIBLE_STRING), eds.getDeviceName());
    assert.equal(await read(0x1018, 2, DataType.UNSIGNED32), IDENTITY.productCode);
    assert.equal(await read(0x1018, 4, DataType.UNSIGNED32), IDENTITY.serialNumber);
    await isRefused(read(0x1234, 0), SdoError, 0x06020000);

    await write(0x1017, 0, 100, DataType.UNSIGNED16);
    assert.equal(await read(0x1017, 0, DataType.UNSIGNED16), 100);
    await write(0x1010, 1, Buffer.from('save'));
    for (const [command, state] of [
        ['startNode', NmtState.OPERATIONAL],
        ['stopNode', NmtState.STOPPED],
        ['enterPreOperational', NmtState.PRE_OPERATIONAL],
        ['resetNode', NmtState.INITIALIZING],
    ]) {
        const change = reported(state);
        nmt[command](NODE_ID);
        await change;
    }
    await reported(NmtState.PRE_OPERATIONAL);
    assert.equal(await read(0x1017, 0, DataType.UNSIGNED16), 100);
}

async function main() {
    await once(bus.socket, 'connect');
    await configure(device);
    await operate(device);
    device.stop();
    bus.close();
}

main().catch((error) => {
    console.error(error);
    process.exit(1);
});
