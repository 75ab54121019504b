"""A scene and a sentence of your own, played by openvima-small.

`python examples/compose_a_scene.py video.mp4` records the second sentence; without a name it only plays.
"""

import sys

import openvima

objects = {
    "block": ("block", "red", (0.45, -0.25)),  # object, texture, x and y in metres
    "bowl": ("bowl", "green", (0.55, 0.25)),
    "heart": ("heart", "blue", (0.6, -0.05), 40),  # turned by 40 degrees
}
goals = [("in", "block", "bowl")]  # without goals the episode ends at its step limit

if __name__ == "__main__":
    video = sys.argv[1] if len(sys.argv) > 1 else None
    for prompt, file in (
        ("Put the {block} into the {bowl}.", None),
        ("Put the red block into the green bowl.", video),
    ):
        episode = openvima.compose(objects, prompt, goals=goals)
        result = openvima.play(episode, "openvima-small", video=file)
        print(prompt, "→ solved" if result.outcome.success else f"→ not solved: {result.outcome.reason}")
