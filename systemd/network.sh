#!/bin/bash
# Gives each installed service the network where its configuration needs it, by a drop-in, and takes it away where it does not:
# a unit speaks to this computer only. Run as root after such a change of the configuration; safe to repeat.
#   network.sh [--root DIR]
set -euo pipefail
root=''
if [ "${1:-}" = --root ]; then root=$2; fi
app=$(dirname "$(dirname "$(dirname "$(realpath "$0")")")") # it lies in share/ceilvo of the program
changed=no

# service NAME CONFIG [PROGRAM]
service() {
  local unit=$1.service config=$2 drop_in=$root/etc/systemd/system/$1.service.d/10-network.conf
  [ -e "$root/etc/systemd/system/$unit" ] || [ -e "$root/usr/lib/systemd/system/$unit" ] || return 0
  if "$app/bin/python" -I -m ceilvo.config.network "$root$config" "${@:3}"; then
    [ -e "$drop_in" ] || changed=yes
    install -d "${drop_in%/*}"
    printf '%s\n' "# Written by network.sh: ${config##*/} needs the network." '[Service]' 'IPAddressDeny=' 'IPAddressAllow=' \
      '# Zenoh lists the network interfaces.' 'RestrictAddressFamilies=AF_NETLINK' \
      >"$drop_in"
    echo "ceilvo: $config needs the network: ${drop_in#"$root"} lets $unit use it"
  elif [ -e "$drop_in" ]; then
    rm -f "$drop_in"
    rmdir --ignore-fail-on-non-empty "${drop_in%/*}"
    changed=yes
  fi
}

service ceilvod /etc/ceilvo/config.yaml
service ceilvo-mapd /etc/ceilvo/mapd.yaml
service ceilvo-web /etc/ceilvo/config.yaml web
if [ "$changed$root" = yes ] && [ -d /run/systemd/system ]; then
  systemctl daemon-reload
  echo "ceilvo: restart the service for it to take effect: systemctl restart ceilvod"
fi
