#!/usr/bin/env bash
# Train ACT on low-level demonstrations of visual_manipulation, and score it by LeRobot and by openvima:
#     train_and_score.sh LEROBOT FOLDER [DEMONSTRATIONS] [STEPS] [EPISODES]
# LEROBOT is the folder of an environment that plugins/lerobot/make_environment.sh made. ACT reads no language:
# it gets the top views of the scene and of the two prompt images, and the state. Everything is on the CPU. The
# backbone starts from random weights, so that it learns at the rate of the rest.
set -eu
usage="usage: train_and_score.sh LEROBOT FOLDER [DEMONSTRATIONS] [STEPS] [EPISODES]"
lerobot=${1:?"$usage"} out=${2:?"$usage"} demonstrations=${3:-1000} steps=${4:-20000} episodes=${5:-50}
image='{"type": "VISUAL", "shape": [3, 128, 256]}'
inputs='"observation.state": {"type": "STATE", "shape": [12]}'
for name in top prompt_0_top prompt_1_top; do inputs="$inputs, \"observation.images.$name\": $image"; done

openvima generate --control end_effector --tasks visual_manipulation --episodes "$demonstrations" --out "$out/demos"
openvima data export-lerobot "$out/demos" "$out/lerobot"
"$lerobot/bin/lerobot-train" --dataset.repo_id=local/demos --dataset.root="$out/lerobot" --dataset.video_backend=pyav \
    --policy.type=act --policy.device=cpu --policy.push_to_hub=false --policy.pretrained_backbone_weights=null \
    --policy.input_features="{$inputs}" --policy.chunk_size=20 --policy.n_action_steps=10 --policy.dim_model=256 \
    --policy.dim_feedforward=1024 --policy.use_vae=false --policy.optimizer_lr=1e-4 \
    --policy.optimizer_lr_backbone=1e-4 --steps="$steps" --save_freq="$steps" --batch_size=8 --num_workers=0 --log_freq=100 \
    --env_eval_freq=0 --wandb.enable=false --seed=0 --output_dir="$out/act"
policy=$out/act/checkpoints/last/pretrained_model
OMP_NUM_THREADS=1 "$lerobot/bin/lerobot-eval" --policy.path="$policy" --policy.device=cpu --env.type=openvima --env.task=visual_manipulation \
    --env.level=L1 --env.control=end_effector --seed=1000 --eval.n_episodes="$episodes" --eval.batch_size=1 \
    --eval.use_async_envs=false --output_dir="$out/lerobot_scores"
openvima evaluate --policy "act=lerobot:$policy" --python "$lerobot/bin/python" --control end_effector --tasks visual_manipulation \
    --levels L1 --seed 1000 --episodes "$episodes" --out "$out/scores"
