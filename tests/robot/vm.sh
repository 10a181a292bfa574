#!/bin/bash
# The virtual robot: Debian with real systemd on a User-Mode-Linux kernel with v4l2loopback. No hardware, no KVM.
#   vm.sh build             make or refresh the cached image and kernel (root; about 1 min and 5 min, once)
#   vm.sh run DIR           boot, run DIR/guest.sh as root inside, power off; exit status = guest.sh's
#   vm.sh run-nspawn DIR    the same in a container on the host's kernel: quick, but without cameras
# Inside, DIR is /mnt/share (read-only) and OUT is /mnt/out. OUT gets log.txt, journal.txt, console.txt.
# Environment: CACHE (images), OUT (results), TTY (host's terminal to be the guest's /dev/ttyS1), MEM in MiB, TIMEOUT in s
set -euo pipefail
CACHE=${CACHE:-${XDG_CACHE_HOME:-$HOME/.cache}/robot_vm}
OUT=$(realpath -m "${OUT:-out}")
MEM=${MEM:-1024} TIMEOUT=${TIMEOUT:-300} TTY=${TTY:-}

IMAGE_VERSION=1
DEBS=systemd,systemd-sysv,udev,kmod,dbus,python3,python3-venv,procps
MASK="apt-daily.timer apt-daily-upgrade.timer dpkg-db-backup.timer e2scrub_all.timer e2scrub_reap.service fstrim.timer
 logrotate.timer getty@tty1.service serial-getty@ttyS0.service systemd-update-utmp.service systemd-networkd.service
 systemd-resolved.service systemd-timesyncd.service systemd-binfmt.service sys-kernel-debug.mount
 sys-kernel-tracing.mount dev-hugepages.mount systemd-pcrphase.service systemd-pcrphase-sysinit.service
 systemd-journal-flush.service systemd-logind.service systemd-user-sessions.service modprobe@drm.service"
# V4L2 needs HAS_IOMEM and HAS_DMA, which User-Mode-Linux has through UML_PCI_OVER_VIRTIO only.
UMCONF="MODULES VIRTIO_UML PCI UML_PCI_OVER_VIRTIO HOSTFS SSL NULL_CHAN PTY_CHAN TTY_CHAN BLK_DEV_UBD EXT4_FS OVERLAY_FS
 TMPFS TMPFS_XATTR TMPFS_POSIX_ACL DEVTMPFS DEVTMPFS_MOUNT CGROUPS CGROUP_FREEZER CGROUP_DEVICE CGROUP_PIDS
 CGROUP_CPUACCT MEMCG CGROUP_SCHED BPF_SYSCALL CGROUP_BPF NAMESPACES USER_NS PID_NS NET_NS IPC_NS UTS_NS SECCOMP
 SECCOMP_FILTER INOTIFY_USER FANOTIFY SIGNALFD TIMERFD EPOLL FHANDLE POSIX_MQUEUE AUTOFS_FS NET UNIX INET
 HIGH_RES_TIMERS NO_HZ_IDLE FB MEDIA_SUPPORT MEDIA_SUPPORT_FILTER MEDIA_CAMERA_SUPPORT MEDIA_TEST_SUPPORT
 V4L_TEST_DRIVERS WATCHDOG SOFT_WATCHDOG DEBUG_INFO_NONE"
# VMAP_STACK: this kernel unmaps pages of such a stack for a moment (flush_tlb_kernel_range). A signal that comes then has no stack,
# faults for ever, and the guest stands still: seen in a debugger.
UMOFF="VMAP_STACK IPV6 REISERFS_FS ISO9660_FS PPP SLIP TUN DUMMY BLK_DEV_NBD IOSCHED_BFQ BINFMT_MISC NETFILTER DRM HID INPUT_MOUSE
 INPUT_KEYBOARD SOUND WIRELESS WLAN RFKILL DEBUG_KERNEL XTERM_CHAN PORT_CHAN MEDIA_SUBDRV_AUTOSELECT SQUASHFS QUOTA
 CRYPTO_MANAGER_DISABLE_TESTS ETHERNET BTRFS_FS XFS_FS JFS_FS USB_SUPPORT GCC_PLUGINS"

log() { printf '[vm %s] %s\n' "$(date +%T)" "$*" >&2; }
words() { tr -s '[:space:]' ' ' <<<"$*" | sed 's/ $/\n/'; }
key() { sha256sum | cut -c1-16; }
candidates() { apt-cache policy "$@" | grep Candidate; }

# need COMMAND[:PACKAGE]...: installs the packages of missing commands.
need() {
  local t missing=()
  for t in "$@"; do
    PATH=$PATH:/usr/sbin:/sbin command -v "${t%%:*}" >/dev/null || missing+=("${t##*:}")
  done
  [ ${#missing[@]} = 0 ] || apt-get install -y --no-install-recommends "${missing[@]}" >/dev/null
}

build_image() {
  local k list=/etc/apt/sources.list.d/debian.sources w=$CACHE/work
  k=$({ words "$IMAGE_VERSION $DEBS $MASK"; candidates systemd python3; guest_files | sha256sum; } | key)
  [ "$(cat "$CACHE/image.key" 2>/dev/null)" != "$k" ] || { log "image is current"; return; }
  need mmdebstrap mke2fs:e2fsprogs
  rm -rf "$w" "$CACHE/image.key"
  mkdir -p "$w"
  [ -f "$list" ] || list=/etc/apt/sources.list
  log "root filesystem"
  nice mmdebstrap --quiet --mode=root --variant=apt --aptopt='Acquire::Check-Valid-Until "false"' \
    --aptopt='Acquire::Languages "none"' --dpkgopt='path-exclude=/usr/share/man/*' \
    --dpkgopt='path-exclude=/usr/share/doc/*' --dpkgopt='path-exclude=/usr/share/locale/*' \
    --include="$DEBS" "$(sed -n 's/^VERSION_CODENAME=//p' /etc/os-release)" "$w/root" "$list" >"$w/log" 2>&1 ||
    { tail -5 "$w/log" >&2; return 1; }
  rm -rf "$w"/root/etc/apt/sources.list* "$w/root/etc/apt/apt.conf.d/99mmdebstrap" "$w/root/var/log/apt"
  guest_config "$w/root"
  log "image"
  rm -rf "$CACHE/image" "$CACHE/image.ext4"
  nice mke2fs -q -F -t ext4 -O ^has_journal,^metadata_csum -m 0 -d "$w/root" "$CACHE/image.ext4" \
    $(($(du -sm "$w/root" | cut -f1) * 115 / 100 + 1024))M
  mv "$w/root" "$CACHE/image"
  rm -rf "$w"
  echo "$k" >"$CACHE/image.key"
}

guest_config() {
  local root=$1 unit
  echo robot >"$root/etc/hostname"
  : >"$root/etc/fstab"
  for unit in $MASK; do ln -sf /dev/null "$root/etc/systemd/system/$unit"; done
  mkdir -p "$root"/etc/systemd/{journald.conf.d,system/multi-user.target.wants} "$root"/mnt/{share,out} "$root/lib/modules"
  printf '[Journal]\nStorage=volatile\nRuntimeMaxUse=16M\nRateLimitIntervalSec=0\n' >"$root/etc/systemd/journald.conf.d/vm.conf"
  guest_files unit >"$root/etc/systemd/system/vmtest.service"
  guest_files script >"$root/usr/local/sbin/vmtest"
  chmod 755 "$root/usr/local/sbin/vmtest"
  ln -sf ../vmtest.service "$root/etc/systemd/system/multi-user.target.wants/"
  ln -sf multi-user.target "$root/etc/systemd/system/default.target"
}

# The unit and the script that run guest.sh; without argument both, for the cache key.
guest_files() {
  case ${1:-unit} in unit) cat <<'U'
[Unit]
Description=run the shared guest script, then power off
After=basic.target systemd-udev-settle.service
SuccessAction=poweroff-force
FailureAction=poweroff-force
[Service]
Type=oneshot
StandardOutput=file:/dev/console
StandardError=inherit
ExecStart=/usr/local/sbin/vmtest
U
  esac
  case ${1:-script} in script) cat <<'S'
#!/bin/bash
opt() { sed -n "s#.*$1=\([^ ]*\).*#\1#p" /proc/cmdline; }
if ! systemd-detect-virt -cq; then
  mount -t hostfs none /mnt/share -o "$(opt vmshare),ro"
  mount -t hostfs none /mnt/out -o "$(opt vmout)"
  mount -t hostfs none /lib/modules -o "$(opt vmmods),ro"
fi
export PATH=/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin
cd /mnt/share
bash ./guest.sh > >(tee /mnt/out/log.txt) 2>&1
rc=$?
wait
journalctl -b --no-pager -o short-monotonic >/mnt/out/journal.txt 2>/dev/null
dmesg >/mnt/out/dmesg.txt
echo $rc >/mnt/out/rc
sync
S
  esac
}

build_kernel() {
  local source k o module u=$CACHE/u
  source=$(apt-cache depends linux-source | awk '/Depends: linux-source-6/{print $2; exit}')
  k=$({ words "$UMCONF $UMOFF"; candidates "$source" v4l2loopback-dkms; } | key)
  [ "$(cat "$CACHE/umkey" 2>/dev/null)" != "$k" ] || { log "kernel is current"; return; }
  need flex bison bc gcc make depmod:kmod xz:xz-utils
  rm -rf "$u" "$CACHE/um" "$CACHE/umkey"
  mkdir -p "$u" "$CACHE/um"
  cd "$u"
  log "download $source"
  apt-get download -qq "$source" v4l2loopback-dkms 2>/dev/null
  for o in *.deb; do dpkg -x "$o" x; done
  tar xf "x/usr/src/$source.tar.xz"
  mv "$source" src
  cd src
  make -s ARCH=um defconfig >/dev/null 2>&1
  for o in $UMCONF; do echo "CONFIG_$o=y"; done >../frag
  for o in $UMOFF; do echo "# CONFIG_$o is not set"; done >>../frag
  printf 'CONFIG_VIDEO_VIVID=m\nCONFIG_UML_PCI_OVER_VIRTIO_DEVICE_ID=1234\n' >>../frag
  scripts/kconfig/merge_config.sh -m .config ../frag >/dev/null 2>&1
  make -s ARCH=um olddefconfig >/dev/null 2>&1
  grep -q VIDEO_VIVID=m .config
  ! grep -q '^CONFIG_VMAP_STACK=y' .config || { log "the kernel has VMAP_STACK, expected none: with it the guest may stand still"; return 1; }
  log "compile the kernel"
  nice make -s -j"$(nproc)" ARCH=um linux modules >../build.log 2>&1 || { tail -5 ../build.log >&2; return 1; }
  module=$(echo "$u"/x/usr/src/v4l2loopback-*)
  nice make -s ARCH=um M="$module" modules >>../build.log 2>&1 || { tail -5 ../build.log >&2; return 1; }
  make -s ARCH=um INSTALL_MOD_PATH="$CACHE/um" INSTALL_MOD_STRIP=1 modules_install >/dev/null 2>&1
  cp "$module/v4l2loopback.ko" "$CACHE"/um/lib/modules/*/
  depmod -b "$CACHE/um" "$(ls "$CACHE/um/lib/modules")"
  strip -o "$CACHE/um/linux" linux
  rm -f "$CACHE"/um/lib/modules/*/{build,source}
  cd "$CACHE"
  rm -rf "$u"
  echo "$k" >"$CACHE/umkey"
}

start() {
  share=$(realpath "$1")
  mkdir -p "$OUT"
  rm -f "$OUT/rc"
}

finish() {
  if [ -f "$OUT/rc" ]; then return "$(cat "$OUT/rc")"; fi
  log "the guest did not finish (exit status $1); see $OUT/console.txt"
  return 70
}

# One processor, and before others: the kernel and its processes trace each other and hand over 3 times faster so, and
# a robot shares its processor with nobody. Where real-time priority is not to be had, a high one must do.
run_um() {
  local r=0 cow cpu priority=(chrt -f 1)
  start "$1"
  cpu=$(taskset -cp $$ | sed 's/.*[ ,-]//')
  [ "$(nproc)" -gt 1 ] && "${priority[@]}" true 2>/dev/null || priority=(nice -n -10)
  echo "${priority[0]}" >"$OUT/priority"
  cow=$(mktemp -u "$OUT/root.XXXXXX")
  # The timeout has a place of its own: a guest that spins would keep it from running.
  timeout -k5 "$TIMEOUT" "${priority[@]}" taskset -c "$cpu" "$CACHE/um/linux" mem="${MEM}M" ubd0="$cow,$CACHE/image.ext4" root=/dev/ubda rootfstype=ext4 rw \
    quiet loglevel=4 panic=-1 con=null con0=fd:0,fd:1 ssl=null ${TTY:+ssl1=tty:$TTY} init=/lib/systemd/systemd \
    systemd.show_status=0 vmshare="$share" vmout="$OUT" vmmods="$CACHE/um/lib/modules" \
    </dev/null >"$OUT/console.txt" 2>&1 || r=$?
  rm -f "$cow"
  finish $r
}

run_nspawn() {
  local r=0
  start "$1"
  need systemd-nspawn:systemd-container
  timeout -k5 "$TIMEOUT" systemd-nspawn -q -b --register=no --keep-unit --volatile=overlay -D "$CACHE/image" \
    --console=pipe --bind-ro="$share:/mnt/share" --bind="$OUT:/mnt/out" ${TTY:+--bind=$TTY:/dev/ttyS1} \
    </dev/null >"$OUT/console.txt" 2>&1 || r=$?
  finish $r
}

case ${1:-} in
  build)
    mkdir -p "$CACHE"
    exec 9>"$CACHE/lock"
    flock 9 # one at a time: the second finds what the first has made
    apt-cache show linux-source >/dev/null 2>&1 || apt-get update -qq
    build_image
    build_kernel ;;
  run) run_um "$2" ;;
  run-nspawn) run_nspawn "$2" ;;
  *) sed -n 2,8p "$0"; exit 2 ;;
esac
