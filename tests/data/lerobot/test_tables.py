"""Parquet files with numbers, and how they are filled."""

from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from openvima.data.lerobot_files import DATA_PATH, FileNumber, NumberedTable


def test_a_chunk_is_full_after_a_thousand_files() -> None:
    assert FileNumber(0, 998).next() == FileNumber(0, 999)
    assert FileNumber(0, 999).next() == FileNumber(1, 0)


@pytest.mark.parametrize("group_bytes", [1000, 10**6])
def test_files_stay_below_their_limit_and_hold_all_rows_in_order(tmp_path: Path, group_bytes: int) -> None:
    limit, numbers = 20_000, []
    with NumberedTable(tmp_path, DATA_PATH, limit_bytes=limit, group_bytes=group_bytes) as table:
        for start in range(0, 10_000, 50):
            numbers.append(table.write(pa.table({"x": pa.array(range(start, start + 50))})))
    files = sorted(tmp_path.rglob("*.parquet"))
    assert len(files) > 2
    assert numbers == sorted(numbers, key=lambda n: n.file)
    assert pq.read_table(files[0])["x"].to_pylist()[-1] == 50 * numbers.count(FileNumber(0, 0)) - 1
    joined = pa.concat_tables([pq.read_table(file) for file in files])
    assert joined["x"].to_pylist() == list(range(10_000))
    assert all(file.stat().st_size < limit for file in files)


def test_rows_written_together_share_a_row_group(tmp_path: Path) -> None:
    with NumberedTable(tmp_path, DATA_PATH, limit_bytes=10**6, group_bytes=500) as table:
        for start in range(0, 300, 30):
            table.write(pa.table({"x": pa.array(range(start, start + 30))}))
    file = pq.ParquetFile(next(tmp_path.rglob("*.parquet")))
    sizes = [file.metadata.row_group(n).num_rows for n in range(file.num_row_groups)]
    assert len(sizes) > 1
    assert all(size % 30 == 0 for size in sizes)
