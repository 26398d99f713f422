#!/bin/bash
#SBATCH --job-name=sweep
#SBATCH --nodes=1
#SBATCH --ntasks=2
#SBATCH --cpus-per-task=1
#SBATCH --hint=nomultithread
#SBATCH --time=01:00:00
#SBATCH --requeue
#SBATCH --open-mode=append
# One case of a sweep per task of the array: sbatch --array=1-4%2 array.sh loaf --set mesh.h=0.02,0.01 ...
set -euo pipefail
limit=3300   # s, five minutes less than --time
export OMP_NUM_THREADS=1
trap : USR1

# Listed anew in each task: the line of a case that was stopped has --restart, that of a finished case does nothing.
line=$(fracsim sweep "$@" --ranks "$SLURM_NTASKS" --list | sed -n "${SLURM_ARRAY_TASK_ID}p")
if [ -z "$line" ]; then
    echo "array.sh: the sweep has no case $SLURM_ARRAY_TASK_ID; cases are numbered from 1" >&2
    exit 2
fi
task=${SLURM_ARRAY_JOB_ID}_$SLURM_ARRAY_TASK_ID code=0
eval "$line --wall-limit $limit" || code=$?
[ "$code" != 4 ] || [ "${SLURM_RESTART_COUNT:-0}" -ge 20 ] || scontrol requeue "$task"
exit "$code"
