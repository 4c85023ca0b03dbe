#!/usr/bin/bash
# The session with cansend and candump. Boards 0 and 1 get node-IDs and a bit rate, all switch to it, and the power
# fails. `serial_numbers` has those of all boards, from the kernel's command line.
set -eu

fail() {
    echo "NOT AS EXPECTED: $*"
    exit 1
}

# Lets the host carry out a command of `cargo emulate --console`.
host() {
    echo "host: $*"
    read -r _
}

# Waits for a frame. Heartbeats may come before it.
expect() {
    local deadline=$((SECONDS + 10)) line
    while ((SECONDS < deadline)) && read -r -t 10 line <&3; do
        echo "$line"
        case ${line##* } in
        "$1") return ;;
        70?#7F) ;;
        *) fail "this frame came, and not $1" ;;
        esac
    done
    fail "$1 did not come within 10 s"
}

# Checks that no more frames come, heartbeats included.
expect_silence() {
    local line
    while read -r -t 0.3 line <&3; do echo "$line"; done # They were under way.
    if read -r -t 3 line <&3; then fail "this frame came: $line"; fi
}

send() {
    cansend slcan0 "$1"
    expect "$1"
}

# Eight bytes: those given, and zeros.
padded() { printf '%.16s' "${1}0000000000000000"; }
lss() { send "7E5#$(padded "$1")"; }
answer() { expect "7E4#$(padded "$1")"; }

# Reads the serial number of the node with this ID by SDO, object 1018h, sub-index 4.
expect_identity() {
    send "60$1#4018100400000000"
    expect "58$1#43181004$2"
}

# As it is in a frame: the lowest byte first.
little_endian() { echo "$1" | sed 's/\(..\)\(..\)\(..\)\(..\)/\4\3\2\1/'; }

exec 3< <(exec candump -L any)
trap "kill $!" EXIT
until grep -q raw /proc/net/can/rcvlist_all; do sleep 0.1; done

set -- $serial_numbers
first=$(little_endian "$1") second=$(little_endian "$2")

echo "can-utils: both boards are blank; each is selected, and gets a node-ID and 500 kbit/s"
lss 4C
answer 50
node_id=5
for serial_number in $first $second; do
    lss 4000000000 # vendor-ID
    lss 413453534C # product code
    lss 4200000100 # revision number
    lss "43$serial_number"
    answer 44
    lss 5D
    answer "5D$serial_number"
    lss 5E
    answer 5EFF
    lss "110$node_id"
    answer 11
    lss 130002
    answer 13
    lss 17
    answer 17
    lss 0400
    expect "70$node_id#00"
    expect_identity $node_id "$serial_number"
    node_id=$((node_id + 1))
done

echo "can-utils: all switch to 500 kbit/s; slcand is started again with -s6"
lss 0401
lss 15E803 # switch delay 1000 ms
sleep 0.5  # The frame may still be on the serial line.
ip link set slcan0 down
killall slcand
while [ -e /sys/class/net/slcan0 ]; do sleep 0.1; done
slcand -o -c -f -s6 -S115200 ttyS1 slcan0
ip link set slcan0 up
sleep 2 # twice the switch delay
expect_identity 5 "$first"
expect_identity 6 "$second"
lss 0400

echo "can-utils: the power fails; node-IDs and bit rate were stored"
host power off 0
host power off 1
expect_silence
host power on 0
expect 705#00
host power on 1
expect 706#00
expect_identity 5 "$first"
expect_identity 6 "$second"
