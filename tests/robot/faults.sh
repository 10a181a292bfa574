#!/bin/bash
# Inside the virtual robot, as root: one fault after the other on the installed service, on a robot that stands still.
# Facts and the times of causes go to /mnt/out/facts.txt, in ns of CLOCK_MONOTONIC, for judge_faults.py.
# shellcheck disable=SC2317
set -uo pipefail
out=/mnt/out
feed=/run/feed
# shellcheck source=/dev/null
. ./robot.env
# shellcheck source=/dev/null
. ./common.sh

# The camera's stable name, as udev gives it to a USB camera, whatever number its node has.
name_camera() {
  echo "SUBSYSTEM==\"video4linux\", ATTR{name}==\"$CAMERA\", SYMLINK+=\"ceiling\"" >/etc/udev/rules.d/99-ceiling.rules
  udevadm control --reload
  sed -i 's#/dev/video0#/dev/ceiling#' /etc/ceilvo/config.yaml
}
plug() {
  modprobe v4l2loopback devices=1 "video_nr=$1" exclusive_caps=1 card_label="$CAMERA" max_buffers=4 || return 1
  udevadm settle
  node=/dev/video$1
}
unplug() {
  feed_stop
  wait_for 10 rmmod v4l2loopback 2>/dev/null
}
feed_start() {
  rm -f "$feed/feed.csv"
  /opt/ceilvo/bin/python feeder.py "$node" "${3:-frames.gray}" "${1:-$WIDTH}" "${2:-$HEIGHT}" "$RATE" "${4:-YUYV}" "$feed" &
  feeder=$!
}
feeds() { [ -s "$feed/feed.csv" ]; }
feed_stop() {
  kill "${feeder:-0}" 2>/dev/null
  wait "${feeder:-}" 2>/dev/null
}
mode() { echo "$1" >"$feed/mode"; }
last_pose() { tail -n 40 "$out/samples.jsonl" 2>/dev/null | grep '/pose"' | tail -1; }
in_state() { last_pose | grep -qE "\"state\": \"($1)\""; }
is_good() { in_state 'TRACKING|DEGRADED'; }
is_bad() { in_state 'DEAD_RECKONING|LOST|RELOCALISING'; }
# Not a pipe: grep -q leaves at the first match, journalctl is then killed while it writes, and pipefail calls that a failure.
said() { grep -q "$1" <<<"$(journalctl -u ceilvod --no-pager -o cat)"; }
begin() { note "$1_begin_ns" "$(mono)"; }
end() { note "$1_end_ns" "$(mono)"; }
health() { tail -n 80 "$out/samples.jsonl" | grep '/health"' | tail -1; }
health_has() { health | grep -qE "$1"; }

setup() {
  install_service >/dev/null || return 1
  name_camera
  mkdir -p "$feed"
  systemctl start ceilvod
  wait_for 5 has_status camera
  note status_absent "$(show StatusText)"
  listen
  begin absent
  plug 0 && feed_start
  end absent
  wait_for 20 in_state TRACKING || return 1
  sleep 3
}

# picture NAME: the feeder's mode for 2 s.
picture() {
  mode "$1"
  wait_for 10 is_bad || return 1
  note "$1_begin_ns" "$(sed -n "s/^$1,//p" "$feed/faults.csv")"
  note "status_$1" "$(show StatusText)"
  sleep 2
  rm "$feed/mode"
  end "$1"
  wait_for 10 in_state TRACKING
}
stalled() { picture stall; }
frozen() { picture frozen; }
black() { picture black; }
white() { picture white; }

replugged() {
  begin replug
  unplug || return 1
  wait_for 10 is_bad || return 1
  wait_for 5 has_status 'no such device'
  note status_replug "$(show StatusText)"
  sleep 1
  plug 3 && feed_start && wait_for 20 feeds || return 1
  end replug
  wait_for 15 in_state TRACKING
}
wrong_format() {
  begin format
  unplug || return 1
  plug 3 && feed_start 320 240 small.gray || return 1
  wait_for 10 said 'asked for YUYV' || return 1
  unplug && plug 3 && feed_start && wait_for 20 feeds || return 1
  end format
  wait_for 15 in_state TRACKING
}
# Layouts of pixels one after the other, on the installed service. Not Y10 and Y12: the loopback device makes their
# buffers for 10 and 12 bits a pixel, where V4L2 has 16, and OpenCV reads beyond them.
formats() {
  local format n
  for format in GREY UYVY NV12 Y16 BA81 MJPG YUYV; do
    systemctl stop ceilvod
    unplug
    sed -i "s/pixel_format: .*/pixel_format: $format/" /etc/ceilvo/config.yaml
    plug 3 && feed_start "" "" "" "$format" && wait_for 20 feeds || return 1
    n=$(poses)
    systemctl start ceilvod
    wait_for 20 has_more_poses_than $((n + 45)) || return 1 # what in_state looks at is all of this process
    wait_for 20 in_state TRACKING || return 1
    note "pixels_$format" TRACKING
  done
}
silent_base() {
  begin base
  touch "$out/base.stop"
  wait_for 10 said 'gave no answer' || return 1
  wait_for 5 health_has '"base_up": false'
  note health_base "$(health | grep -o '"base_up": [a-z]*')"
  sleep 1
  rm "$out/base.stop"
  end base
  wait_for 10 health_has '"base_up": true'
}
clock_steps() {
  local n
  begin clock
  date -s '+1 hour' >/dev/null && n=$(poses) && wait_for 10 has_more_poses_than $((n + 15)) || return 1
  date -s '-2 hours' >/dev/null && n=$(poses) && wait_for 10 has_more_poses_than $((n + 15)) || return 1
  date -s '+1 hour' >/dev/null
  end clock
  is_good
}
disk_full() {
  begin disk
  fallocate -l "$(df --output=avail -B1 / | tail -1)" /fill 2>/dev/null
  dd if=/dev/zero of=/fill2 bs=4k 2>/dev/null
  wait_for 25 health_has '"store_error": "[^"]*(No space left|disk is full)' || return 1
  is_good || return 1
  rm -f /fill /fill2
  end disk
  wait_for 25 health_has '"store_error": ""'
}
read_only() {
  begin readonly
  chmod 500 /var/lib/ceilvo
  wait_for 25 health_has '"store_error": "[^"]*Permission denied' || return 1
  is_good || return 1
  chmod 750 /var/lib/ceilvo
  end readonly
  wait_for 25 health_has '"store_error": ""'
}
starved() {
  local pid n
  pid=$(show MainPID)
  n=$(poses)
  begin starved
  # A quarter of a processor: stopped for three quarters of every 80 ms.
  /opt/ceilvo/bin/python -c "
import os, signal, sys, time
pid, until = int(sys.argv[1]), time.monotonic() + 6
while time.monotonic() < until:
    os.kill(pid, signal.SIGSTOP); time.sleep(.06); os.kill(pid, signal.SIGCONT); time.sleep(.02)
" "$pid"
  end starved
  note starved_poses $(($(poses) - n))
  wait_for 10 in_state TRACKING
}
memory() {
  local pid
  pid=$(show MainPID)
  begin memory
  systemd-run --quiet --wait /usr/bin/python3 -c "
x = []
while True:
    x.append(bytearray(1 << 24))
" 2>/dev/null
  note memory_hog_status $?
  end memory
  note memory_same_process "$([ "$(show MainPID)" = "$pid" ] && echo yes || echo no)"
  wait_for 15 in_state TRACKING
}
kills() {
  local k pid t0 n
  for k in 1 2 3 4 5; do
    another_life none || return 1 # MainPID=0 would be this script's own group
    pid=$(show MainPID)
    t0=$(mono)
    kill -KILL "$pid"
    sleep 2 # nobody needs to ask sooner: systemd keeps the moment
    another_life "$pid" || return 1
    note "kill${k}_ns" "$t0"
    note "life${k}_ns" "$(ready_ns)"
    n=$(poses)
    EVERY_S=1 wait_for 15 has_more_poses_than "$n" || return 1
    sleep "0.$((RANDOM % 9 + 1))"
  done
  note rejected "$(find /var/lib/ceilvo -name '*.rejected' -o -name '*.tmp' | wc -l)"
  wait_for 20 is_good
}
corrupt_state() {
  systemctl stop ceilvod
  echo 'half a fi' >/var/lib/ceilvo/map.db
  systemctl start ceilvod
  wait_for 10 said 'set aside as map.db.rejected' || return 1
  wait_for 10 said 'the last good copy, map.db.good of' || return 1
  wait_for 20 in_state TRACKING
}
corrupt_calibration() {
  systemctl stop ceilvod
  head -c 200 calibration.yaml >/etc/ceilvo/calibration.yaml
  systemctl start ceilvod 2>/dev/null
  note calibration_end "status $(show ExecMainStatus), $(show ActiveState)"
  cp calibration.yaml /etc/ceilvo/
  systemctl reset-failed ceilvod
  systemctl start ceilvod
  wait_for 20 is_good
}

rc=0
rm -f "$out/facts.txt" "$out/samples.jsonl"
for phase in ${PHASES:-setup stalled frozen black white replugged wrong_format formats silent_base clock_steps disk_full read_only \
  starved kills memory corrupt_state corrupt_calibration}; do
  enter "$phase"
  gave_up=
  if $phase; then note "phase_$phase" ok; else
    step "$phase failed"
    last_pose | cut -c1-400
    note "phase_$phase" "failed${gave_up:+, last waited for $gave_up}"
    rc=1
    rm -f "$feed/mode" "$out/base.stop" /fill /fill2
    [ "$phase" = setup ] && break
  fi
done
systemctl stop ceilvod
journalctl -u ceilvod --no-pager -o short-monotonic >"$out/service.txt"
feed_stop
kill "${listener:-}" 2>/dev/null
enter end
exit $rc
