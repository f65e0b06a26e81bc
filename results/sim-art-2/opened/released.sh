#!/bin/bash
# SPDX-License-Identifier: MIT
# Does it open, by the released models, on 100 clouds of 100 fresh objects each: released.sh OUT
set -e
out=$1
for entry in clean:{laptop,safe,eyeglasses,oven,washer} sensor:{basket,drawer,laptop,scissors,suitcase}; do
  IFS=: read -r part category <<< "$entry"
  flags=() model=$category
  [ "$part" = sensor ] && flags=(--preset sim-art-sensor --noise disparity --mask imperfect)
  [ "$entry" = sensor:laptop ] && model=laptop-sensor
  scapo-data generate "$category" --split test --count 100 --instances 100 --seed 18 "${flags[@]}" --out "$out/$part"
  for mode in quick refine; do
    scapo-bench predict "results/checkpoints/$model.safetensors" --data "$out/$part" --split test --mode $mode \
      --row released --out "$out/$part-$category-$mode.safetensors"
    scapo-data actuate "$out/$part-$category-$mode.safetensors" --data "$out/$part" \
      --out "$out/scores/$part-$category-$mode-actuate.csv"
  done
done
scapo-bench tables --scores "$out/scores" --split test --out "$out/tables"
