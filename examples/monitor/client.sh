#!/bin/sh
# A client of `evofsm monitor` in shell: starts it, sends rows through a pipe, prints the first alarm.
#
# sh client.sh            # evofsm has to be on the path; or: EVOFSM="python -m evofsm" sh client.sh
#
# It ends with 0 after an alarm, 1 where none came.
set -eu

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
mkfifo "$folder/rows" "$folder/decisions"
${EVOFSM:-evofsm} monitor --warm <"$folder/rows" >"$folder/decisions" &
exec 3>"$folder/rows" 4<"$folder/decisions"

status=1
k=0
while [ "$k" -lt 110 ]; do
    gap=$((600 - 5 * k)) # in 0.1 m: closing in at 5 m/s, ten rows a second
    time="$((k / 10)).$((k % 10))"
    echo "{\"time\":$time,\"gap\":$((gap / 10)).$((gap % 10)),\"v_follower\":20,\"v_leader\":15,\"proposal\":0}" >&3
    read -r answer <&4
    case $answer in
    *'"alarm":true'*)
        echo "alarm at $time s: $answer"
        status=0
        break
        ;;
    *'"kind":"error"'*) echo "refused: $answer" >&2 ;;
    esac
    k=$((k + 1))
done
exec 3>&- 4<&- # the end of the rows ends it
wait
exit "$status"
