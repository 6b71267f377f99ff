#!/usr/bin/env bash
# Trains on one machine or several with torchrun. Start it on every machine, with the same variables and arguments:
#
#   GPUS=8 EXPERIMENT=obstacles jobs/torchrun.sh                                        # one machine
#   NODES=2 GPUS=8 RENDEZVOUS=first-machine:29500 EXPERIMENT=obstacles jobs/torchrun.sh   # on each of two machines
#
# NODES       machines (1); 1:4 trains on one to four, and restarts from the last checkpoint when one joins or leaves
# GPUS        processes on each machine, one for each GPU (1)
# EXPERIMENT  a file of conf/experiment (obstacles)
# RENDEZVOUS  host:port of one of the machines, reachable from all; needed where NODES is not 1
# HGN_RUN     name of the run (EXPERIMENT): its folder is runs/HGN_RUN, or the folder of run=
# RESTARTS    how often all processes are started again when one has failed (3)
# PYTHON      the interpreter (python)
#
# Further arguments go to python -m hgn.train, for example run=/shared/runs/first dataset.folder=/shared/data.
# The run folder and the data set must be folders that all machines share.
set -euo pipefail

NODES=${NODES:-1}
GPUS=${GPUS:-1}
EXPERIMENT=${EXPERIMENT:-obstacles}
RENDEZVOUS=${RENDEZVOUS:-}
RESTARTS=${RESTARTS:-3}
PYTHON=${PYTHON:-python}

if ! [[ $NODES =~ ^[1-9][0-9]*(:[1-9][0-9]*)?$ ]]; then
    echo "error: NODES must be a whole number of at least 1, or two as in 1:4, got '$NODES'" >&2
    exit 2
fi
if ! [[ $GPUS =~ ^[1-9][0-9]*$ ]]; then
    echo "error: GPUS must be a whole number of at least 1, got '$GPUS'" >&2
    exit 2
fi
if ! [[ $RESTARTS =~ ^[0-9]+$ ]]; then
    echo "error: RESTARTS must be a whole number, got '$RESTARTS'" >&2
    exit 2
fi
if [[ $NODES == 1 ]]; then
    RENDEZVOUS=${RENDEZVOUS:-localhost:0}
elif [[ -z $RENDEZVOUS ]]; then
    echo "error: RENDEZVOUS must be host:port of one of the $NODES machines, got nothing; as in RENDEZVOUS=node0:29500" >&2
    exit 2
fi

# Otherwise restarted processes find the addresses of those before them, and hang (pytorch issue 135712).
export TORCH_DISABLE_SHARE_RDZV_TCP_STORE=1
export TORCH_ELASTIC_SHUTDOWN_TIMEOUT=${TORCH_ELASTIC_SHUTDOWN_TIMEOUT:-120} # seconds between SIGTERM and SIGKILL

# torchrun sets the same for several processes, and prints a warning.
[[ $GPUS == 1 ]] || export OMP_NUM_THREADS=${OMP_NUM_THREADS:-1}

exec "$PYTHON" -m torch.distributed.run --nnodes "$NODES" --nproc-per-node "$GPUS" --max-restarts "$RESTARTS" \
    --rdzv-backend c10d --rdzv-endpoint "$RENDEZVOUS" --rdzv-id "${HGN_RUN:-$EXPERIMENT}" \
    --signals-to-handle SIGTERM,SIGINT,SIGHUP,SIGQUIT,SIGUSR1 \
    -m hgn.train "+experiment=$EXPERIMENT" "$@"
