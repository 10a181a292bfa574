# Shared by the scripts that run inside the virtual robot; sourced after $out, $feed and robot.env are set.
# shellcheck shell=bash disable=SC2154

mono() {
  local up
  read -r up _ </proc/uptime
  echo "${up/./}0000000"
}
now() { date +%s%N; }
note() { printf '%s=%s\n' "$1" "$2" >>"$out/facts.txt"; }
step() { printf '[%6.1f] %s\n' "$(cut -d' ' -f1 /proc/uptime)" "$*"; }
# enter PHASE: says where the guest was, should it stand still.
enter() {
  step "$1"
  note in_phase "$1"
}
show() { systemctl show -P "$1" ceilvod; }

# wait_for SECONDS COMMAND...: until it succeeds.
wait_for() {
  local until=$(($(mono) + $1 * 1000000000))
  shift
  until "$@"; do
    [ "$(mono)" -lt "$until" ] || { gave_up=$* && step "gave up waiting for: $*"; return 1; }
    sleep "${EVERY_S:-0.05}"
  done
}
poses() { grep -c '/pose"' "$out/samples.jsonl" 2>/dev/null || true; }
is_tracking() { grep -q '/pose".*"state": "TRACKING"' "$out/samples.jsonl" 2>/dev/null; }
has_more_poses_than() { [ "$(poses)" -gt "$1" ]; }
is_another_life() {
  # One question: two answers would be of two moments.
  local answer
  answer=$(systemctl show -p MainPID,ActiveState ceilvod)
  grep -q '^ActiveState=active$' <<<"$answer" && ! grep -qE "^MainPID=(0|$1)$" <<<"$answer"
}
# ready_ns: when the service said that it is ready, by CLOCK_MONOTONIC; systemd keeps it, so nobody has to be quick.
ready_ns() { echo "$(show ActiveEnterTimestampMonotonic)000"; }
# another_life PID: waits for it. Each question takes processes on the one processor that the daemon starts on.
another_life() { EVERY_S=0.5 wait_for 20 is_another_life "$1"; }
has_status() { show StatusText | grep -qi "$1"; }

install_service() {
  local t0
  t0=$(now)
  bash kit/systemd/install.sh --wheel kit/ceilvo-*.whl --wheels wheels || return 1
  note install_ms $((($(now) - t0) / 1000000))
  note verify "$(systemd-analyze verify --man=no /etc/systemd/system/ceilvod.service 2>&1 | tr '\n' ' ')"
  note exposure "$(systemd-analyze security --no-pager ceilvod.service | sed -n 's/.*exposure level.*: \([0-9.]*\) .*/\1/p')"
  cp config.yaml calibration.yaml /etc/ceilvo/
  ceilvod check-config /etc/ceilvo/config.yaml
  note check_config_status $?
}

listen() {
  "${app:-/opt/ceilvo}/bin/python" listener.py "$ENDPOINT" "$out/samples.jsonl" "$STEM"/{pose,health,event} &
  # shellcheck disable=SC2034
  listener=$!
}
