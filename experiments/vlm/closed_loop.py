"""Close the loop: demonstrations, chats, a tiny VLM trained on them, its server, and `openvima evaluate`.

The VLM has 0.6 M weights, starts from nothing and learns 32 episodes by heart: what is tried is the way, not
the model. It is the only place where episodes of an evaluation are trained on. Minutes on two cores:

    pip install 'openvima[vlm,train]' 'transformers[serving]'
    python experiments/vlm/closed_loop.py --out closed_loop
"""

import argparse
import json
import os
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from tokenizers import Tokenizer, models, pre_tokenizers, trainers
from tokenizers.decoders import ByteLevel
from transformers import (
    CLIPVisionConfig,
    LlamaConfig,
    LlavaConfig,
    LlavaForConditionalGeneration,
    LlavaProcessor,
    PreTrainedTokenizerFast,
)
from transformers.models.clip.image_processing_pil_clip import CLIPImageProcessorPil

from openvima.cli.main import main as openvima
from openvima.data.chat import ChatFormat
from openvima.data.chat_export import EXAMPLES_NAME, export_chat
from openvima.data.encoding import ShardInfo
from openvima.data.manifest import finish_folder
from openvima.data.records import package_versions, rollout_oracle
from openvima.data.shard import ShardWriter
from openvima.env import EnvConfig
from openvima.evaluation import Results

TASK, LEVEL, EPISODES, ENLARGE = "visual_manipulation", "L1", 32, 1
IMAGE, PATCH, WIDTH, VOCABULARY = 64, 16, 128, 800
LEARNING_RATE, IGNORED = 2e-3, -100
SPECIAL = ("<pad>", "<image>", "<user>", "<assistant>", "<end>")
TEMPLATE = (
    "{% for message in messages %}<{{ message['role'] }}>{% for part in message['content'] %}"
    "{{ '<image>' if part['type'] == 'image' else part['text'] }}{% endfor %}<end>{% endfor %}"
    "{% if add_generation_prompt %}<assistant>{% endif %}"
)


def record(folder: Path) -> None:
    """Write demonstrations of the evaluation's own episodes, which `openvima generate` never does."""
    env = EnvConfig().make(TASK, LEVEL, domain="eval")
    info = ShardInfo(TASK, LEVEL, "eval", 0, EPISODES, 0, versions=package_versions(), **EnvConfig().record())
    folder.mkdir(parents=True)
    with ShardWriter(folder / info.file_name, info) as writer:
        for seed in range(EPISODES):
            writer.write(rollout_oracle(env, seed))
    finish_folder(folder, [folder / info.file_name], command=__file__, config={}, versions=info.versions)


def build_processor(texts: Sequence[str]) -> LlavaProcessor:
    """Make a tokenizer whose longest words are the fixed sentences; digits stay apart."""
    tokenizer = Tokenizer(models.BPE())
    tokenizer.pre_tokenizer = pre_tokenizers.Sequence(
        [pre_tokenizers.Digits(individual_digits=True), pre_tokenizers.ByteLevel(False, use_regex=False)]
    )
    tokenizer.decoder = ByteLevel()
    alphabet = pre_tokenizers.ByteLevel.alphabet()
    trainer = trainers.BpeTrainer(
        vocab_size=VOCABULARY, special_tokens=[*SPECIAL], initial_alphabet=alphabet, show_progress=False
    )
    tokenizer.train_from_iterator(texts, trainer)
    fast = PreTrainedTokenizerFast(
        tokenizer_object=tokenizer,
        pad_token="<pad>",
        eos_token="<end>",
        extra_special_tokens={"image_token": "<image>"},
    )
    side = {"height": IMAGE, "width": IMAGE}
    images = CLIPImageProcessorPil(size=side, do_center_crop=False)
    return LlavaProcessor(
        images,
        fast,
        patch_size=PATCH,
        vision_feature_select_strategy="default",
        num_additional_image_tokens=1,
        chat_template=TEMPLATE,
    )


def build_model(processor: LlavaProcessor) -> LlavaForConditionalGeneration:
    """Make a LLaVA of random weights."""
    tokens = processor.tokenizer
    vision = CLIPVisionConfig(
        hidden_size=64,
        intermediate_size=128,
        num_hidden_layers=1,
        num_attention_heads=4,
        image_size=IMAGE,
        patch_size=PATCH,
    )
    text = LlamaConfig(
        vocab_size=len(tokens),
        hidden_size=WIDTH,
        intermediate_size=2 * WIDTH,
        num_hidden_layers=2,
        num_attention_heads=4,
        max_position_embeddings=2048,
        pad_token_id=tokens.pad_token_id,
        bos_token_id=None,
        eos_token_id=tokens.eos_token_id,
    )
    config = LlavaConfig(
        vision_config=vision,
        text_config=text,
        image_token_index=tokens.convert_tokens_to_ids("<image>"),
        vision_feature_layer=-1,
        image_seq_length=(IMAGE // PATCH) ** 2,
    )
    model = LlavaForConditionalGeneration(config)
    model.generation_config.eos_token_id = tokens.eos_token_id
    model.generation_config.pad_token_id = tokens.pad_token_id
    return model


def encode(processor: LlavaProcessor, chats: Path) -> list[dict[str, torch.Tensor]]:
    """Encode the examples of an export; only the last message, the answer, counts in the loss."""
    encoded = []
    for line in (chats / EXAMPLES_NAME).read_text(encoding="utf-8").splitlines():
        example = json.loads(line)
        images = [Image.open(chats / name).convert("RGB") for name in example["images"]]
        whole = processor.apply_chat_template(example["messages"])
        asked = processor.apply_chat_template(example["messages"][:-1], add_generation_prompt=True)
        inputs = processor(images=images, text=whole, return_tensors="pt")
        length = processor(images=images, text=asked, return_tensors="pt")["input_ids"].shape[1]
        labels = inputs["input_ids"][0].clone()
        labels[:length] = IGNORED
        encoded.append({"ids": inputs["input_ids"][0], "labels": labels, "images": inputs["pixel_values"]})
    return encoded


def train(model: LlavaForConditionalGeneration, examples: list[dict[str, torch.Tensor]], steps: int) -> None:
    """Train on all examples at once until the loss says that they are known."""
    pad = torch.nn.utils.rnn.pad_sequence
    ids = pad(
        [each["ids"] for each in examples],
        batch_first=True,
        padding_value=model.config.text_config.pad_token_id,
    )
    labels = pad([each["labels"] for each in examples], batch_first=True, padding_value=IGNORED)
    mask = pad([torch.ones_like(each["ids"]) for each in examples], batch_first=True)
    images = torch.cat([each["images"] for each in examples])
    optimizer = torch.optim.AdamW(model.parameters(), LEARNING_RATE, weight_decay=0.0)
    warm = torch.optim.lr_scheduler.LambdaLR(optimizer, lambda step: min(1.0, (step + 1) / 20))
    started = time.perf_counter()
    for step in range(steps):
        loss = model(input_ids=ids, attention_mask=mask, pixel_values=images, labels=labels).loss
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        optimizer.step()
        warm.step()
        if step % 20 == 0 or loss < 0.01:
            print(f"step {step}: loss {loss:.4f}, {time.perf_counter() - started:.0f} s", flush=True)
        if loss < 0.01:
            return


def wait_for(url: str, server: "subprocess.Popen[bytes]") -> None:
    """Wait until a server answers."""
    while server.poll() is None:
        try:
            urllib.request.urlopen(url, timeout=5).close()
        except (urllib.error.URLError, TimeoutError):
            time.sleep(1)
        else:
            return
    raise SystemExit("transformers serve has ended; see its message above.")


def main() -> None:
    """Run all of it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("closed_loop"))
    parser.add_argument("--steps", type=int, default=2000)
    parser.add_argument("--port", type=int, default=8123)
    arguments = parser.parse_args()
    out: Path = arguments.out.absolute()
    demos, chats, model_folder = out / "demos", out / "chats", out / "model"
    record(demos)
    export_chat(demos, chats, form=ChatFormat(enlarge=ENLARGE))
    torch.manual_seed(0)
    lines = (chats / EXAMPLES_NAME).read_text(encoding="utf-8").splitlines()
    blocks = [
        part for line in lines for message in json.loads(line)["messages"] for part in message["content"]
    ]
    processor = build_processor([part["text"] for part in blocks if part["type"] == "text"])
    model = build_model(processor)
    examples = encode(processor, chats)
    weights = sum(np.prod(each.shape) for each in model.parameters())
    print(f"{weights / 1e6:.2f} M weights, {max(len(e['ids']) for e in examples)} tokens", flush=True)
    train(model, examples, arguments.steps)
    model.eval().save_pretrained(model_folder)
    processor.save_pretrained(model_folder)
    words = [
        "serve",
        str(model_folder),
        "--port",
        str(arguments.port),
        "--host",
        "127.0.0.1",
        "--device",
        "cpu",
    ]
    server = subprocess.Popen(
        [sys.executable, "-m", "transformers.cli.transformers", *words],
        env={**os.environ, "HF_HUB_OFFLINE": "1"},
    )
    try:
        wait_for(f"http://127.0.0.1:{arguments.port}/health", server)
        words = ["evaluate", "--policy", f"tiny=vlm:{model_folder}", "--tasks", TASK, "--levels", LEVEL]
        words += ["--base-url", f"http://127.0.0.1:{arguments.port}/v1", "--episodes", str(EPISODES)]
        words += ["--vlm.points", "1000-xy", "--vlm.enlarge", str(ENLARGE), "--vlm.concurrency", "2"]
        openvima([*words, "--out", str(out / "scores"), "--no-report", "--force"])
    finally:
        server.terminate()
        server.wait()
    (row,) = Results.read(out / "scores").rows
    print(f"{row.successes} of {row.episodes} episodes solved over the network; failures: {row.failures}")


if __name__ == "__main__":
    main()
