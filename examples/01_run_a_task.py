"""Run one task with `python examples/01_run_a_task.py`: print the prompt and execute the oracle's action."""

import openvima

env = openvima.make("rotate", level="L1")
observation, info = env.reset(seed=7)

print("Prompt:", info["prompt"])
for part in env.unwrapped.prompt.sequence():  # text and images in reading order
    print("  text " if isinstance(part, str) else "  image", part if isinstance(part, str) else part.objects)
print("Front view:", observation["rgb"]["front"].shape, observation["rgb"]["front"].dtype)
print("Objects in view:", sorted(set(observation["segm"]["top"].ravel().tolist()) - {0, 1}))

decision = env.unwrapped.oracle_decision()  # the scripted oracle; a policy gets prompt and observation
print("Pick at", decision.action.pose0_position, "place at", decision.action.pose1_position)

observation, reward, terminated, truncated, info = env.step(decision.action.to_arrays())
print("Solved:", info["success"])
