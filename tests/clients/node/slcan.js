/** A CAN bus behind an SLCAN (LAWICEL) adapter that is reached by TCP. */

const EventEmitter = require('events');
const net = require('net');

/** The commands that set these bit rates, in kbit/s. */
const BIT_RATES = { 10: 'S0', 20: 'S1', 50: 'S2', 125: 'S4', 250: 'S5', 500: 'S6', 800: 'S7', 1000: 'S8' };

/** Takes frames `{ id, data }` by `send` and emits those received as `message`; 11-bit data frames only. */
class SlcanBus extends EventEmitter {
    constructor(port, kbit) {
        super();
        let pending = '';
        this.socket = net.connect(port, '127.0.0.1').setEncoding('ascii').setNoDelay();
        this.socket.on('data', (text) => {
            const lines = (pending + text).split('\r');
            pending = lines.pop();
            lines.forEach((line) => this._receive(line));
        });
        this.socket.write(`${BIT_RATES[kbit]}\rO\r`);
    }

    send({ id, data }) {
        const hex = Buffer.from(data).toString('hex');
        this.socket.write(`t${id.toString(16).padStart(3, '0')}${data.length}${hex}\r`);
    }

    close() {
        this.socket.end('C\r');
    }

    _receive(line) {
        const frame = /^t([0-9A-F]{3})([0-8])((?:[0-9A-F]{2})*)$/i.exec(line);
        if (frame === null)
            return;
        const data = Buffer.from(frame[3], 'hex');
        this.emit('message', { id: parseInt(frame[1], 16), data, len: data.length });
    }
}

module.exports = { SlcanBus };
