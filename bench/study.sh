#!/usr/bin/env bash
# The figures of the README: three seeds of each recording, from training to evaluation.
# Usage: CVO_DATA=... CVO_WEIGHTS=... bench/study.sh WORK_FOLDER [redkitchen|kitchen_flights] [SEED ...]
# Writes bench/results/<recording>-<seed>.json and .txt; interrupted, it goes on.
set -euo pipefail
work=$1 recording=$2
shift 2
results=$(cd "$(dirname "$0")" && pwd)/results
weights=$CVO_WEIGHTS/mobilenetv2_100_imagenet.safetensors
dataset=7scenes:$CVO_DATA/$recording
split=random
[ "$recording" = kitchen_flights ] && split=sequence
mkdir -p "$work"
[ $# -gt 0 ] || set -- 0 1 2
for seed in "$@"; do
  run=$work/$recording-$seed
  start=$(date +%s)
  cvo-export train cjp "$dataset" "$run" --split "$split" --seed "$seed" --weights "$weights"
  cvo-export publish "$run" "$run-bundle" --rule pooled > /dev/null
  trained=$(date +%s)
  cvo-export evaluate "$run-bundle" "$dataset" --json "$results/$recording-$seed.json" > "$results/$recording-$seed.txt"
  echo "train and publish $((trained - start)) s, evaluate $(($(date +%s) - trained)) s" >> "$results/$recording-$seed.txt"
  cat "$results/$recording-$seed.txt"
done
