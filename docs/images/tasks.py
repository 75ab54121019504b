"""Make tasks.png beside this file: the prompt and a solved scene of each task of the benchmark."""

import tempfile
from pathlib import Path

from openvima.catalog.partitions import PUBLISHED_TASKS
from openvima.report.task_gallery import SHEET_NAME, save_task_gallery

with tempfile.TemporaryDirectory() as folder:
    save_task_gallery(Path(folder), tasks=sorted(PUBLISHED_TASKS))
    sheet = Path(folder, SHEET_NAME).read_bytes()
Path(__file__).with_suffix(".png").write_bytes(sheet)
