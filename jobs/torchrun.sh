#!/usr/bin/env bash
# Trains on one machine or several with torchrun. Start it on every machine, with the same variables and arguments:
#
#   GPUS=8 EXPERIMENT=obstacles jobs/torchrun.sh                                        # one machine
#   NODES=2 GPUS=8 RENDEZVOUS=first-machine:29500 EXPERIMENT=obstacles jobs/torchrun.sh   # on each of two machines
#
# NODES       machines (1)
# GPUS        processes on each machine, one for each GPU (1)
# EXPERIMENT  a file of conf/experiment (obstacles)
# RENDEZVOUS  host:port of one of the machines, reachable from all; needed where NODES > 1
# PYTHON      the interpreter (python)
#
# Further arguments go to python -m hgn.train, for example run=/shared/runs/first dataset.folder=/shared/data.
# The run folder and the data set must be folders that all machines share.
set -euo pipefail

NODES=${NODES:-1}
GPUS=${GPUS:-1}
EXPERIMENT=${EXPERIMENT:-obstacles}
RENDEZVOUS=${RENDEZVOUS:-}
PYTHON=${PYTHON:-python}

for name in NODES GPUS; do
    if ! [[ ${!name} =~ ^[1-9][0-9]*$ ]]; then
        echo "error: $name must be a whole number of at least 1, got '${!name}'" >&2
        exit 2
    fi
done

if ((NODES == 1)); then
    launch=(--standalone)
elif [[ -n $RENDEZVOUS ]]; then
    launch=(--rdzv-backend c10d --rdzv-endpoint "$RENDEZVOUS" --rdzv-id "hgn-$EXPERIMENT")
else
    echo "error: RENDEZVOUS must be host:port of one of the $NODES machines, got nothing; as in RENDEZVOUS=node0:29500" >&2
    exit 2
fi

exec "$PYTHON" -m torch.distributed.run --nnodes "$NODES" --nproc-per-node "$GPUS" "${launch[@]}" \
    -m hgn.train "+experiment=$EXPERIMENT" "training.nodes=$NODES" "training.devices=$GPUS" "$@"
