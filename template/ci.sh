#!/usr/bin/env bash
# What CI checks: the tests, and the session for real boards (`cargo hil`) with an emulated one.
set -euo pipefail
cd "$(dirname "$0")"
readonly product=$PWD
export CARGO_TARGET_DIR=${CARGO_TARGET_DIR:-$product/target}

cargo test
cargo firmware
cargo eds

# Its commands come from where the libraries are.
cd "$(cargo metadata --format-version 1 | sed -n 's|.*"manifest_path":"\([^"]*\)/lab/testkit/Cargo.toml".*|\1|p')"
chip=$(sed -n 's|^chip = .*/\(stm32[a-z0-9]*\)".*|\1|p' "$product/Cargo.toml")
controller=$(sed -n 's|^pub type Can = pac::CAN\([123]\);|can\1|p' "$product/src/pins.rs")
# The crystal has 8 MHz; `--crystal` gives another.
coproc emulator {
    exec cargo emulate --listen 127.0.0.1:0 --boards 0 --chip "$chip" --controller "$controller" \
        --elf "$CARGO_TARGET_DIR/thumbv7em-none-eabihf/release/@name@"
}
readonly pid=$emulator_PID
exec 3<&"${emulator[0]}"
trap 'kill "$pid"' EXIT
read -r ready <&3
address=${ready#*SLCAN on }
cargo hil --adapter "slcan:tcp:${address%%;*}" --eds "$product/@name@.eds" --quick --ask never

# The report of the emulator, which fails if the program did what a chip does not tolerate.
trap - EXIT
kill "$pid"
cat <&3
wait "$pid"
