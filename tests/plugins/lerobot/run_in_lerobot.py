"""Runs in LeRobot's environment: saves scripted policies or a SmolVLA, and runs lerobot-eval on a policy.

Usage: python run_in_lerobot.py save FOLDER CONTROL
       python run_in_lerobot.py smolvla FOLDER CONTROL
       python run_in_lerobot.py eval ACTIONS.json OPTIONS_OF_LEROBOT_EVAL…
"""

import json
import sys
from pathlib import Path

import numpy as np
from lerobot.scripts import lerobot_eval
from lerobot_env_openvima import OpenVimaEnv


def save(folder: Path, control: str) -> None:
    """Save the scripted policy of a control, with processors that pass everything on."""
    from lerobot.processor import PolicyProcessorPipeline
    from lerobot.processor.device_processor import DeviceProcessorStep
    from lerobot.processor.rename_processor import RenameObservationsProcessorStep
    from lerobot_policy_scripted.configuration_scripted import ScriptedConfig
    from lerobot_policy_scripted.modeling_scripted import ScriptedPolicy

    config = ScriptedConfig(device="cpu", push_to_hub=False, low_level=control == "end_effector")
    ScriptedPolicy(config).save_pretrained(folder)
    steps = [RenameObservationsProcessorStep(rename_map={}), DeviceProcessorStep(device="cpu")]
    PolicyProcessorPipeline(steps=steps, name="policy_preprocessor").save_pretrained(folder)
    PolicyProcessorPipeline(steps=steps[1:], name="policy_postprocessor").save_pretrained(folder)


def save_smolvla(folder: Path, control: str) -> None:
    """Save a tiny SmolVLA with random weights, and beside it the VLM that its config names.

    The VLM has SmolVLM's architecture, and a tokenizer of single bytes. Nothing is downloaded. Cameras have
    the names of the published base model, as after `lerobot-train --rename_map`.
    """
    import torch
    from lerobot.configs import FeatureType, PolicyFeature
    from lerobot.policies.smolvla.configuration_smolvla import SmolVLAConfig
    from lerobot.policies.smolvla.modeling_smolvla import SmolVLAPolicy
    from lerobot.policies.smolvla.processor_smolvla import make_smolvla_pre_post_processors
    from tokenizers import Tokenizer, models, pre_tokenizers
    from transformers import (
        PreTrainedTokenizerFast,
        SmolVLMConfig,
        SmolVLMImageProcessor,
        SmolVLMProcessor,
        SmolVLMVideoProcessor,
    )

    names = ("<pad>", "<bos>", "<end_of_utterance>", "<image>", "<fake_token_around_image>", "<global-img>")
    words = [*names, *sorted(pre_tokenizers.ByteLevel.alphabet())]
    tokenizer = Tokenizer(models.BPE(vocab={word: number for number, word in enumerate(words)}, merges=[]))
    tokenizer.pre_tokenizer = pre_tokenizers.ByteLevel(add_prefix_space=False)
    roles = ("end_of_utterance_token", "image_token", "fake_image_token", "global_image_token")
    fast = PreTrainedTokenizerFast(
        tokenizer_object=tokenizer,
        pad_token=names[0],
        bos_token=names[1],
        eos_token=names[2],
        extra_special_tokens=dict(zip(roles, names[2:], strict=True)),
    )
    sizes = {"intermediate_size": 64, "num_attention_heads": 2}
    vision = {"hidden_size": 32, "num_hidden_layers": 1, "image_size": 64, "patch_size": 16}
    text = {"hidden_size": 64, "num_hidden_layers": 2, "num_key_value_heads": 1, "head_dim": 32}
    text |= {"model_type": "llama", "vocab_size": len(words), "pad_token_id": 0}
    vlm, settings = folder / "vlm", {"image_token_id": 3, "pad_token_id": 0, "scale_factor": 2}
    SmolVLMConfig(vision_config=sizes | vision, text_config=sizes | text, **settings).save_pretrained(vlm)
    processors = (SmolVLMImageProcessor(), fast, SmolVLMVideoProcessor())
    SmolVLMProcessor(*processors, image_seq_len=4).save_pretrained(vlm)

    numbers, state = (5, 12) if control == "end_effector" else (12, 7)
    image = PolicyFeature(FeatureType.VISUAL, (3, 128, 256))
    cameras = {"front": "camera1", "top": "camera2", "prompt_0_top": "camera3"}
    config = SmolVLAConfig(
        input_features={
            **{f"observation.images.{camera}": image for camera in cameras.values()},
            "observation.state": PolicyFeature(FeatureType.STATE, (state,)),
        },
        output_features={"action": PolicyFeature(FeatureType.ACTION, (numbers,))},
        device="cpu",
        push_to_hub=False,
        vlm_model_name=str(vlm),
        resize_imgs_with_padding=(64, 64),
        num_vlm_layers=2,
        num_steps=2,
    )
    torch.manual_seed(0)
    SmolVLAPolicy(config).save_pretrained(folder)
    lengths = {"observation.state": state, "action": numbers}
    statistics = {
        name: {"mean": torch.zeros(length), "std": torch.full((length,), 0.1)}
        for name, length in lengths.items()
    }
    before, after = make_smolvla_pre_post_processors(config, statistics)
    names = {f"observation.images.{ours}": f"observation.images.{camera}" for ours, camera in cameras.items()}
    before.steps[0].rename_map = names
    for processor in (before, after):
        processor.save_pretrained(folder)


def evaluate(actions: Path, options: list[str]) -> None:
    """Run lerobot-eval and store the actions of each seed, as the environment takes them."""
    found: dict[int, list] = {}
    step = OpenVimaEnv.step

    def recorded(env: OpenVimaEnv, action):
        made = env._layout.action(action)
        parts = [made] if isinstance(made, np.ndarray) else list(made.values())
        taken = np.concatenate(parts).tolist()
        found.setdefault(env._env.episode.seed, []).append(taken)
        return step(env, action)

    OpenVimaEnv.step = recorded
    sys.argv = ["lerobot-eval", *options]
    lerobot_eval.main()
    actions.write_text(json.dumps(found))


if __name__ == "__main__":
    if sys.argv[1] in ("save", "smolvla"):
        {"save": save, "smolvla": save_smolvla}[sys.argv[1]](Path(sys.argv[2]), sys.argv[3])
    else:
        evaluate(Path(sys.argv[2]), sys.argv[3:])
