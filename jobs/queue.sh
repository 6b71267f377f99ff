#!/usr/bin/env bash
# Works through a list of commands on one machine, one at a time on each GPU:
#
#   jobs/queue.sh jobs/networks.txt                               # on all GPUs
#   CUDA_VISIBLE_DEVICES=0,1 jobs/queue.sh mine.txt runs/my_queue   # on two of them, with logs in runs/my_queue
#
# LIST, the first argument, has a line `NAME: COMMAND` for each command, which bash runs in the present folder;
# variables of the environment may be used, as in ${SCENES:-800}. A line `wait` is a barrier: later commands begin
# when all earlier ones are done. Empty lines and those that begin with # are skipped.
# FOLDER, the second (runs/queue), gets NAME.log, and NAME.done once the command has ended with exit code 0.
#
# Each GPU (those of CUDA_VISIBLE_DEVICES where it is set, else all that nvidia-smi lists; without any, the CPU) takes
# the next command, which sees only that GPU. The same call again runs the commands that are not done. If a command
# fails, the others before the next barrier still run, none after it begins, and the exit code is 1.
# Ctrl-C, SIGTERM and SIGHUP reach the commands as SIGTERM and are waited for, so that they can write checkpoints; the
# exit code is then 128 + the signal's number.
set -euo pipefail

if (($# < 1 || $# > 2)); then
    echo "usage: jobs/queue.sh LIST [FOLDER]; as in jobs/queue.sh jobs/networks.txt" >&2
    exit 2
fi
list=$1
folder=${2:-runs/queue}
if ! [[ -f $list && -r $list ]]; then
    echo "error: LIST must be a file that can be read, got '$list'; as in jobs/queue.sh jobs/networks.txt" >&2
    exit 2
fi

names=()
commands=()
stages=() # how many barriers stand before each

read_list() {
    local line name command fault number=0 stage=0
    declare -A line_of
    refuse() {
        echo "error: $list:$number: $1" >&2
        exit 2
    }
    while IFS= read -r line || [[ -n $line ]]; do
        number=$((number + 1))
        line=${line#"${line%%[![:space:]]*}"}
        line=${line%"${line##*[![:space:]]}"}
        if [[ -z $line || $line == '#'* ]]; then
            continue
        elif [[ $line == wait ]]; then
            stage=$((stage + 1))
            continue
        elif ! [[ $line =~ ^([A-Za-z0-9][A-Za-z0-9_.-]*):[[:space:]]+(.+)$ ]]; then
            refuse "a line must be NAME: COMMAND (letters, digits, _ . -) or wait, got '$line'; as in first: echo 1"
        fi
        name=${BASH_REMATCH[1]} command=${BASH_REMATCH[2]}
        if [[ -n ${line_of[$name]:-} ]]; then
            refuse "names must differ, got '$name' as in line ${line_of[$name]}; give it another"
        fi
        if ! fault=$(bash -n -c "$command" 2>&1); then
            refuse "the command of '$name' must be one that bash can read, got '$command'; mend it: ${fault##*: }"
        fi
        line_of[$name]=$number
        names+=("$name")
        commands+=("$command")
        stages+=("$stage")
    done <"$list"
    if ((${#names[@]} == 0)); then
        echo "error: $list must have a line NAME: COMMAND, got none; add one, as in first: echo 1" >&2
        exit 2
    fi
}

# What a command is: its text, and those of the variables that it names which are set; any GPU will do.
identity() {
    local rest=$1 variable seen=' CUDA_VISIBLE_DEVICES '
    printf '%s\n' "$1"
    while [[ $rest =~ \$\{?([A-Za-z_][A-Za-z0-9_]*) ]]; do
        variable=${BASH_REMATCH[1]}
        rest=${rest#*"${BASH_REMATCH[0]}"}
        if [[ -v $variable && $seen != *" $variable "* ]]; then
            printf '%s=%s\n' "$variable" "${!variable}"
        fi
        seen+="$variable "
    done
}

is_done() {
    [[ -e $folder/${names[$1]}.done ]]
}

check_done() {
    local i
    for i in "${!names[@]}"; do
        if is_done "$i" && [[ $(<"$folder/${names[$i]}.done") != "$(identity "${commands[$i]}")" ]]; then
            echo "error: $folder/${names[$i]}.done must be of the command in $list, with the same variables, got" \
                "another; work in another folder, or remove the file to run the command" >&2
            exit 2
        fi
    done
}

gpus=()

find_gpus() {
    local listed
    if [[ -n ${CUDA_VISIBLE_DEVICES+set} ]]; then
        IFS=, read -r -a gpus <<<"${CUDA_VISIBLE_DEVICES// /}"
    elif command -v nvidia-smi >/dev/null; then
        listed=$(nvidia-smi --query-gpu=index --format=csv,noheader 2>&1) || true
        if ! [[ $listed =~ ^[0-9]+($'\n'[0-9]+)*$ ]]; then
            echo "error: nvidia-smi must list the GPUs, got '${listed//$'\n'/ }'; say which there are, as in" \
                "CUDA_VISIBLE_DEVICES=0,1, or that there are none, CUDA_VISIBLE_DEVICES=" >&2
            exit 2
        fi
        mapfile -t gpus <<<"$listed"
        export CUDA_DEVICE_ORDER=PCI_BUS_ID # CUDA then counts as nvidia-smi does
    fi
    if ((${#gpus[@]} == 0)); then
        gpus=(cpu)
    fi
}

say() { # GPU, name, what
    printf '%(%F %T)T  GPU %s  %s  %s\n' -1 "$1" "$2" "$3"
}

wait_for() { # a trapped signal ends a wait, not the process
    local code=0
    while kill -0 "$1" 2>/dev/null; do
        wait "$1" || true
    done
    wait "$1" || code=$?
    return "$code"
}

# Whether a process of the group has not ended; those that nobody waits for (zombies) have.
group_runs() {
    local file stat state group
    kill -0 -- "-$1" 2>/dev/null || return 1
    for file in /proc/[0-9]*/stat; do
        # One that is gone by now reads as nothing; $(<FILE) would end this shell then.
        stat=''
        { IFS= read -r -d '' stat <"$file"; } 2>/dev/null || true
        read -r state _ group _ <<<"${stat##*) }"
        if [[ $group == "$1" && $state != [ZX] ]]; then
            return 0
        fi
    done
    return 1
}

# What one GPU does between two barriers: takes commands that nobody has taken, until none is left or a signal comes.
work() { # GPU, stage
    local gpu=$1 stage=$2 i name code begun running='' stopping='' told=''
    hand_on() {
        stopping=1
        if [[ -n $running ]]; then
            # before its first moment is over, it has no group yet
            kill -s TERM -- "-$running" 2>/dev/null || kill -s TERM "$running" 2>/dev/null || true
            told=1
        fi
    }
    trap hand_on TERM
    trap '' INT HUP # a terminal's reach the script too, which tells this process
    if [[ $gpu != cpu ]]; then
        export CUDA_VISIBLE_DEVICES=$gpu
    fi
    for i in "${!names[@]}"; do
        name=${names[$i]}
        if [[ -n $stopping ]]; then
            return
        elif ((stages[i] != stage)) || is_done "$i" || ! mkdir "$taken/$i" 2>/dev/null; then
            continue
        fi
        say "$gpu" "$name" begin
        begun=$SECONDS
        # A session of its own, so that a signal reaches all of its processes, and none past this script. With a trap
        # its shell waits for what runs, and then goes on with nothing more.
        setsid bash -c "trap 'exit 143' TERM"$'\n'"${commands[$i]}" </dev/null >>"$folder/$name.log" 2>&1 &
        running=$!
        if [[ -n $stopping && -z $told ]]; then # the signal came before the line above
            hand_on
        fi
        code=0
        wait_for "$running" || code=$?
        if [[ -z $stopping ]] && group_runs "$running"; then # what it has left behind would be in the next one's way
            kill -s TERM -- "-$running" 2>/dev/null || true
        fi
        while group_runs "$running"; do
            sleep 0.2
        done
        running=''
        if ((code == 0)); then
            identity "${commands[$i]}" >"$folder/.$name.done"
            mv "$folder/.$name.done" "$folder/$name.done"
        fi
        say "$gpu" "$name" "end, exit code $code, $((SECONDS - begun)) s"
    done
}

read_list
mkdir -p "$folder"
if [[ -L $folder/.lock || -e $folder/.lock && ! -f $folder/.lock ]]; then
    echo "error: $folder/.lock must be a file, got a link, pipe, device or folder; delete it" >&2
    exit 2
fi
exec {lock}>"$folder/.lock" # commands keep it open: what a killed queue leaves behind holds it too
if ! flock -n "$lock"; then
    echo "error: FOLDER must be one that no other queue works in, got '$folder'; wait for it, or take another" >&2
    exit 2
fi
check_done
find_gpus
taken=$(mktemp -d)
trap 'rm -r "$taken"' EXIT

workers=()
signal=''
stop() {
    signal=$1
    printf '%(%F %T)T  SIG%s: waiting for what runs to end\n' -1 "$1"
    for worker in "${workers[@]}"; do
        kill -s TERM "$worker" 2>/dev/null || true
    done
}
trap 'stop INT' INT
trap 'stop TERM' TERM
trap 'stop HUP' HUP

echo "${#names[@]} commands, GPUs: ${gpus[*]}, logs in $folder"
for ((stage = 0; stage <= stages[-1]; stage++)); do
    for gpu in "${gpus[@]}"; do
        if [[ -n $signal ]]; then
            break
        fi
        work "$gpu" "$stage" &
        workers+=($!)
        if [[ -n $signal ]]; then # it may have come before the line above
            kill -s TERM "${workers[-1]}" 2>/dev/null || true
        fi
    done
    for worker in "${workers[@]}"; do
        wait_for "$worker" || true # what it has not done is seen below
    done
    workers=()
    failed=() behind=()
    for i in "${!names[@]}"; do
        if is_done "$i"; then
            continue
        elif ((stages[i] <= stage)); then
            failed+=("${names[$i]}")
        else
            behind+=("${names[$i]}")
        fi
    done
    left="${failed[*]} ${behind[*]}"
    if [[ -n $signal && $left != ' ' ]]; then
        echo "stopped by SIG$signal; not done: $left; the same call goes on"
        exit "$((128 + $(kill -l "$signal")))"
    elif ((${#failed[@]} > 0)); then
        echo "failed: ${failed[*]}; see $folder/NAME.log. Not begun, behind the barrier: ${behind[*]:-nothing};" \
            "the same call goes on"
        exit 1
    fi
done
echo "all ${#names[@]} commands are done"
