#!/usr/bin/busybox sh
# The first process in the Linux of `cargo verify linux`: connects slcan0 to the emulated bus and runs /command.
export PATH=/usr/sbin:/usr/bin
busybox mkdir -p /proc /sys /dev /run /tmp
busybox mount -t proc proc /proc
busybox mount -t sysfs sys /sys
busybox mount -t devtmpfs dev /dev
busybox ln -s /proc/self/fd /dev/fd
busybox --install -s /usr/bin 2>/dev/null # The commands of the other packages stay.
stty -echo
uname -sr

depmod 2>/dev/null # It warns that most modules were left out.
modprobe -a slcan can-raw
# The second serial line is an SLCAN adapter on the bus; at a lower speed of the line frames come too late.
slcand -o -c -f -s4 -S115200 ttyS1 slcan0 && ip link set slcan0 up

sh /command
echo "host: end $?"
poweroff -f
