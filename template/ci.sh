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
# The crystal has 8 MHz; `--crystal` gives another.
coproc emulator {
    exec cargo emulate --listen 127.0.0.1:0 --boards 0 --chip @chip@ --controller can@controller@ \
        --elf "$CARGO_TARGET_DIR/thumbv7em-none-eabihf/release/@name@"
}
trap 'kill "$emulator_PID"' EXIT
read -r ready <&"${emulator[0]}"
address=${ready#*SLCAN on }
cargo hil --adapter "slcan:tcp:${address%%;*}" --eds "$product/@name@.eds" --quick --ask never
