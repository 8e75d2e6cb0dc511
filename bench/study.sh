#!/usr/bin/env bash
# The figures of the README: from training to evaluation.
# Usage: CVO_DATA=... CVO_WEIGHTS=... bench/study.sh WORK_FOLDER METHOD redkitchen|kitchen_flights [SEED ...]
# NAME=mcqr-passes OPTIONS="--augmentation predictions" before it trains a variant under a name of its own.
# Writes bench/results/<method or name>-<recording>-<seed>.json and .txt; interrupted, it goes on.
set -euo pipefail
work=$1 method=$2 recording=$3
shift 3
results=$(cd "$(dirname "$0")" && pwd)/results
weights=$CVO_WEIGHTS/mobilenetv2_100_imagenet.safetensors
dataset=7scenes:$CVO_DATA/$recording
split=random
[ "$recording" = kitchen_flights ] && split=sequence
mkdir -p "$work"
[ $# -gt 0 ] || set -- 0 1 2
for seed in "$@"; do
  name=${NAME:-$method}-$recording-$seed
  start=$(date +%s)
  cvo-export train "$method" "$dataset" "$work/$name" --split "$split" --seed "$seed" --weights "$weights" --cache "$work/features" ${OPTIONS:-}
  trained=$(date +%s)
  cvo-export publish "$work/$name" "$work/$name-bundle" --rule pooled > /dev/null
  published=$(date +%s)
  cvo-export evaluate "$work/$name-bundle" "$dataset" --json "$results/$name.json" > "$results/$name.txt"
  echo "train $((trained - start)) s, publish $((published - trained)) s, evaluate $(($(date +%s) - published)) s" >> "$results/$name.txt"
  cat "$results/$name.txt"
done
