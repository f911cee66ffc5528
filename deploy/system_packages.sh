#!/bin/sh
# Installs the system libraries that pip cannot install, or prints the command for it.
# usage: system_packages.sh run|test
set -eu

packages="python3-venv libegl1 libgl1 libgl1-mesa-dri"
if [ "$1" = test ]; then
    packages="$packages chromium xvfb iproute2 nftables tcc libc6-dev libzmq3-dev pulseaudio pulseaudio-utils"
    packages="$packages mono-mcs mono-runtime espeak-ng mecab mecab-ipadic-utf8"
fi

if [ "$(uname)" = Darwin ]; then exit 0; fi # macOS includes OpenGL
if ! command -v apt-get >/dev/null; then
    echo "this is not a Debian system; install the equivalents of these packages: $packages" >&2
    exit 0
fi
missing=""
for package in $packages; do
    dpkg-query --show --showformat='${Status}' "$package" 2>/dev/null | grep -q 'ok installed' ||
        missing="$missing $package"
done
if [ -z "$missing" ]; then exit 0; fi
install="apt-get install --yes --no-install-recommends$missing"
if [ "$(id -u)" = 0 ]; then
    echo "installing$missing"
    log=$(mktemp)
    if ! { apt-get update && DEBIAN_FRONTEND=noninteractive $install; } >"$log" 2>&1; then
        tail -n 20 "$log" >&2
        exit 1
    fi
    rm -f "$log"
else
    echo "system libraries are missing; run this command, then make again:" >&2
    echo "    sudo $install" >&2
    exit 1
fi
