#!/bin/bash
# Inside the virtual robot, as root: the Debian package installed, configured, tracking, upgraded, removed, purged.
# Facts go to /mnt/out/facts.txt for judge_deb.py; nothing is judged here.
# shellcheck disable=SC2317
set -uo pipefail
out=/mnt/out
feed=/run/feed
app=/usr/lib/ceilvo
export DEBIAN_FRONTEND=noninteractive
# shellcheck source=/dev/null
. ./robot.env
# shellcheck source=/dev/null
. ./common.sh

dpkg_() { dpkg --force-confold "$@" 2>&1 | sed 's/^/  /'; }
version() { dpkg-query -W -f '${db:Status-Status} ${Version}' ceilvo 2>/dev/null || echo none; }
states() { systemctl is-active "$1"; }
digest() { sha256sum "$@" 2>/dev/null | cut -c1-16 | tr '\n' ' '; }
landmarks() { ceilvod map stats --json /var/lib/ceilvo/map.db 2>/dev/null | tr ',' '\n' | sed -n 's/.*"landmarks": *\([0-9]*\).*/\1/p' | head -1; }
all_named() { find / -xdev \( -path /mnt -o -path /var/log \) -prune -o -iname '*ceilvo*' -print | sort | tr '\n' ' '; }
page() {
  "$app"/bin/python -c 'import sys, urllib.request as r; print(r.urlopen("http://127.0.0.1:8480/", timeout=5).status)' 2>/dev/null | grep -q 200
}
poses_of_now() {
  local n
  n=$(poses)
  wait_for 20 has_more_poses_than $((n + 15)) && wait_for 20 tail_tracks
}
tail_tracks() { tail -n 40 "$out/samples.jsonl" | grep '/pose"' | tail -1 | grep -q '"state": "TRACKING"'; }

install() {
  local t0
  t0=$(now)
  dpkg_ -i deb/old.deb
  note install_ms $((($(now) - t0) / 1000000))
  note installed "$(version)"
  note enabled "$(systemctl is-enabled ceilvod ceilvo-web ceilvo-mapd 2>&1 | tr '\n' ' ')"
  note active_at_first "$(states ceilvod)"
  note users "$(grep -c '^ceilvo' /etc/passwd)"
  note verify "$(systemd-analyze verify --man=no /usr/lib/systemd/system/ceilvo*.service 2>&1 | tr '\n' ' ')"
  note kernel "$("$app"/bin/python -c 'from ceilvo.daemon.vision import kernel as v; from ceilvo.daemon.odometry import kernel as o; print(v.COMPILED and o.COMPILED)')"
}
configure() {
  cp config.yaml calibration.yaml /etc/ceilvo/
  ceilvod check-config /etc/ceilvo/config.yaml
  note check_config_status $?
}
track() {
  mkdir -p "$feed"
  modprobe v4l2loopback devices=1 video_nr=0 exclusive_caps=1 card_label="$CAMERA" max_buffers=4 || return 1
  udevadm settle
  "$app"/bin/python feeder.py /dev/video0 frames.gray "$WIDTH" "$HEIGHT" "$RATE" YUYV "$feed" &
  feeder=$!
  systemctl start ceilvod ceilvo-web || return 1
  listen
  wait_for 30 is_tracking || return 1
  touch "$feed/go"
  note page "$(wait_for 20 page && echo yes)"
  wait_for 20 test -s /var/lib/ceilvo/map.db
  ceilvod doctor >"$out/doctor.txt" 2>&1
  note doctor "$(awk '$2 ~ /^(unit|map|kernel)$/ {print $2 ":" $1}' "$out/doctor.txt" | sort | tr '\n' ' ')"
  wait_for 60 test -e "$feed/played" || return 1
  note before_tracking "$(tail_tracks && echo yes)"
}
upgrade() {
  local pid t0 web
  pid=$(show MainPID)
  web=$(systemctl show -P MainPID ceilvo-web)
  note kept_before "$(digest /etc/ceilvo/config.yaml /etc/ceilvo/calibration.yaml)"
  note landmarks_before "$(landmarks)"
  t0=$(now)
  dpkg_ -i deb/new.deb
  note upgrade_ms $((($(now) - t0) / 1000000))
  note upgraded "$(version)"
  note kept_after "$(digest /etc/ceilvo/config.yaml /etc/ceilvo/calibration.yaml)"
  note new_defaults "$(cd /etc/ceilvo && echo config.yaml.dpkg-*)"
  note landmarks_after "$(landmarks)"
  another_life "$pid" && note restarted yes
  note web_restarted "$([ "$(systemctl show -P MainPID ceilvo-web)" != "$web" ] && states ceilvo-web)"
  poses_of_now && note after_tracking yes
}
remove() {
  systemctl disable --quiet ceilvo-web
  kill "${feeder:-}" "${listener:-}" 2>/dev/null # they run on the package's Python
  dpkg_ -r ceilvo
  note removed "$(version)"
  note active_removed "$(states ceilvod)"
  # shellcheck disable=SC2012
  note commands_removed "$(ls /usr/bin/ceilvod /usr/bin/calib "$app"/bin 2>/dev/null | tr '\n' ' ')"
  note kept_removed "$(digest /etc/ceilvo/config.yaml /etc/ceilvo/calibration.yaml)"
  note map_removed "$([ -s /var/lib/ceilvo/map.db ] && echo yes)"
}
purge() {
  journalctl -u ceilvod --no-pager -o short-monotonic >"$out/service.txt"
  dpkg_ -P ceilvo
  note purged "$(version)"
  note left "$(all_named)"
  note users_left "$(cat /etc/passwd /etc/group | grep -c '^ceilvo')"
}

rc=0
rm -f "$out/facts.txt" "$out/samples.jsonl"
for phase in install configure track upgrade remove purge; do
  enter "$phase"
  $phase || {
    step "$phase failed"
    rc=1
    note failed_phase "$phase"
    systemctl --no-pager --full status ceilvod
    break
  }
done
[ -e "$out/service.txt" ] || journalctl -u ceilvod --no-pager -o short-monotonic >"$out/service.txt"
enter end
exit $rc
