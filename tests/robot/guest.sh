#!/bin/bash
# Inside the virtual robot, as root: install, start without a camera, drive, kill, stop, uninstall.
# Facts go to /mnt/out/facts.txt for judge.py; nothing is judged here.
# shellcheck disable=SC2317
set -uo pipefail
out=/mnt/out
feed=/run/feed
# shellcheck source=/dev/null
. ./robot.env

# shellcheck source=/dev/null
. ./common.sh

start_without_camera() {
  local t0
  t0=$(now)
  systemctl start ceilvod
  note start_status $?
  note start_ms $((($(now) - t0) / 1000000))
  wait_for 5 has_status camera
  note status_without_camera "$(show StatusText)"
}

plug_camera_in() {
  mkdir -p "$feed"
  modprobe v4l2loopback devices=1 video_nr=0 exclusive_caps=1 card_label="$CAMERA" max_buffers=4 || return 1
  udevadm settle
  /opt/ceilvo/bin/python feeder.py /dev/video0 frames.gray "$WIDTH" "$HEIGHT" "$RATE" YUYV "$feed" &
  feeder=$!
  listen
}

drive() {
  wait_for 20 is_tracking || return 1
  note cpu_before_ns "$(show CPUUsageNSec)"
  note go_ns "$(now)"
  touch "$feed/go"
  wait_for 90 test -e "$feed/played" || return 1
  sleep 0.3
  note played_ns "$(now)"
  note cpu_after_ns "$(show CPUUsageNSec)"
  note memory_bytes "$(show MemoryCurrent)"
  note status_tracking "$(show StatusText)"
  note restarts_before "$(show NRestarts)"
}

# A program that does not know where the daemon listens.
be_found() {
  /opt/ceilvo/bin/python listener.py "" "$out/found.jsonl" "$STEM/pose" &
  wait_for 15 test -s "$out/found.jsonl" && note found yes
  kill $!
}

# A picture, and how many processes draw.
be_seen() {
  /opt/ceilvo/bin/python listener.py "$ENDPOINT" "$out/pictures.jsonl" "$STEM/image" &
  wait_for 20 test -s "$out/pictures.jsonl" && note picture "$(sed -n '1s/.*"body": "\(.*\)".*/\1/p' "$out/pictures.jsonl")"
  note artists "$(pgrep -c -f replay.pictures) $(ps -o cls= -p "$(pgrep -o -f replay.pictures)" | tr -d " ")"
  kill $!
}

# restarted NAME SIGNAL: how long until another process is ready, then some of its poses.
restarted() {
  local pid n t0
  pid=$(show MainPID)
  note "$1_ns" "$(now)"
  t0=$(mono)
  kill "$2" "$pid"
  another_life "$pid" || return 1
  note "$1_ready_ms" $((($(ready_ns) - t0) / 1000000))
  # What was under way when the old life ended has arrived by now.
  n=$(poses)
  wait_for 15 has_more_poses_than $((n + 15))
}
kill_hard() { restarted kill -KILL; }
hang() { restarted hang -STOP; }

stop() {
  local t0
  t0=$(now)
  note stop_ns "$t0"
  systemctl stop ceilvod
  note stop_ms $((($(now) - t0) / 1000000))
  note stop_code "$(show ExecMainCode)"
  note stop_status "$(show ExecMainStatus)"
  note stop_result "$(show Result)"
}

refuse_wrong_config() {
  echo 'camra: {}' >>/etc/ceilvo/config.yaml
  systemctl start ceilvod 2>/dev/null
  note wrong_config "status $(show ExecMainStatus), restarts $(show NRestarts), $(show ActiveState)"
  cp config.yaml /etc/ceilvo/
  systemctl reset-failed ceilvod
}

uninstall() {
  bash /opt/ceilvo/share/ceilvo/install.sh uninstall || return 1
  note leftovers "$(find / -xdev -path /mnt -prune -o -iname '*ceilvo*' -print | sort | tr '\n' ' ')"
  note user_left "$(grep -c ceilvo /etc/passwd)"
}

rc=0
rm -f $out/facts.txt "$out"/{samples,found,pictures}.jsonl
for phase in install_service start_without_camera plug_camera_in drive be_found be_seen kill_hard hang stop refuse_wrong_config; do
  enter "$phase"
  $phase || { step "$phase failed"; rc=1; note failed_phase $phase; break; }
done
kill "${feeder:-}" "${listener:-}" 2>/dev/null
[ -f "$feed/feed.csv" ] && cp $feed/feed.csv $out/
cp -r /var/lib/ceilvo $out/state
journalctl -u ceilvod --no-pager -o short-monotonic >$out/service.txt
if [ $rc = 0 ]; then
  enter uninstall
  uninstall || { rc=1; note failed_phase uninstall; }
else
  systemctl --no-pager --full status ceilvod
  tail -20 $out/service.txt
fi
enter end
exit $rc
