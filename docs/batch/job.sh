#!/bin/bash
#SBATCH --job-name=fracsim
#SBATCH --nodes=1
#SBATCH --ntasks=8
#SBATCH --cpus-per-task=1
#SBATCH --hint=nomultithread
#SBATCH --time=04:00:00
#SBATCH --requeue
#SBATCH --open-mode=append
# One run, queued again until it is done: sbatch job.sh STUDY OUT
set -euo pipefail
study=$1 out=$2
limit=14100   # s, five minutes less than --time: the last checkpoint and frame are written in that time
export OMP_NUM_THREADS=1
trap : USR1   # `scancel --signal=USR1 --full JOBID` ends the run with a checkpoint, and this script goes on

restart=()
[ ! -e "$out/checkpoint/state.h5" ] || restart=(--restart)
code=0
mpirun -n "$SLURM_NTASKS" fracsim run "$study" -o "$out" --wall-limit "$limit" "${restart[@]}" || code=$?
[ "$code" != 4 ] || [ "${SLURM_RESTART_COUNT:-0}" -ge 20 ] || scontrol requeue "$SLURM_JOB_ID"
exit "$code"
