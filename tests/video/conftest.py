"""Made-up results, prompts and clips."""

from small_data_sets import clip, prompt, results

__all__ = ["clip", "prompt", "results"]
