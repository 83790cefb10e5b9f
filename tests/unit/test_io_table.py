"""Tables in all the shapes that CSV comes in; rows known by the line number an editor shows."""

import time

import numpy as np
import pyarrow as pa
import pyarrow.parquet
import pytest

from helmstar.errors import DataError
from helmstar.io.table import read_table


def table(tmp_path, content, name="t.csv"):
    file = tmp_path / name
    file.write_bytes(content if isinstance(content, bytes) else content.encode())
    return read_table(file)


@pytest.mark.parametrize(
    "content",
    [
        "a,b,c\n1,2,3\n4,5,6\n",
        "a;b;c\r\n1;2;3\r\n4;5;6",
        "a\tb\tc\n1\t2\t3\n4\t5\t6\n",
        "  a   b c\n 1  2\t3\n4 5 6   \n",
        "\ufeffa,b,c\n1,2,3\n4,5,6\n",
        '"a", "b" ,"c"\n"1",2,"3"\n 4 ,5,6\n',
        "a,b,c\r1,2,3\r4,5,6\r",
        "# a,b,c\n1,2,3\n4,5,6\n",
        "a,b,c,\n1,2,3,\n4,5,6,\n",
        "a,b,c\n1,2,3,\n4,5,6,\n",
        "a,b,c\n1.0D+00,2,3\n+4,5e0,6\n",
        "a,b,c\n1,2,3\n4,5,6\n".encode("utf-16"),
    ],
)
def test_every_layout_gives_the_same_numbers(tmp_path, content):
    read = table(tmp_path, content)
    assert list(read.columns) == ["a", "b", "c"]
    np.testing.assert_array_equal(np.stack([read.numbers(c).value for c in "abc"]).T, [[1, 2, 3], [4, 5, 6]])
    assert not read.problems


def test_rows_are_numbered_as_in_an_editor(tmp_path):
    read = table(tmp_path, "# source\n\na,b\n1,2\n\n# remark\n3\n4,5\n6,7,8\n\n9,10")
    assert read.row.tolist() == [4, 8, 11]
    assert [(p.row, p.kind, p.action) for p in read.problems] == [(7, "ragged", "dropped"), (9, "ragged", "dropped")]


def test_cells_are_numbers_absent_or_bad(tmp_path):
    read = table(tmp_path, b"a,b\n1,x\n ,1_0\nnan,\xff\xfe\nabc,1\x00\n-inf,1e999\n")
    a, b = read.numbers("a"), read.numbers("b")
    assert a.empty.tolist() == [False, True, False, False, False]
    assert a.bad.tolist() == [False, False, False, True, False]
    assert b.bad.tolist() == [True, True, True, True, False]
    assert np.isinf(b.value[4])


def test_quotes_that_do_not_close_spoil_one_row_only(tmp_path):
    read = table(tmp_path, 'a,b\n1,"2\n3,4\n"5,6",7\n')
    assert read.row.tolist() == [3, 4]
    assert [p.row for p in read.problems] == [2]
    assert read.numbers("a").bad.tolist() == [False, True]


def test_parquet_types(tmp_path):
    content = pa.table(
        {
            "a": pa.array([1, None, 3], pa.int32()),
            "b": pa.array(["1.5", "x", None]),
            "t": pa.array([0, 1_500_000, None], pa.timestamp("us", "UTC")),
            **{f"d_{unit}": pa.array([0, 1500, None], pa.duration(unit)) for unit in ("s", "ms", "us", "ns")},
        }
    )
    pa.parquet.write_table(content, tmp_path / "x.parquet")
    read = read_table(tmp_path / "x.parquet")
    assert read.row.tolist() == [1, 2, 3]
    assert read.numbers("a").empty.tolist() == [False, True, False]
    assert read.numbers("b").bad.tolist() == [False, True, False]
    for unit, tick in (("s", 1.0), ("ms", 1e-3), ("us", 1e-6), ("ns", 1e-9)):
        seconds = read.numbers(f"d_{unit}")
        assert seconds.value[:2].tolist() == [0.0, pytest.approx(1500 * tick, rel=1e-15)]
        assert seconds.empty.tolist() == [False, False, True]
    assert read.texts("t").to_pylist() == ["1970-01-01 00:00:00.000000Z", "1970-01-01 00:00:01.500000Z", ""]


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("t.csv", b"", "empty"),
        ("t.csv", b"# only\n\n", "comments"),
        ("t.csv", b"a,b\n", "no row"),
        ("t.csv", b"1,2\n3,4\n", "column names"),
        ("t.csv", bytes(range(256)) * 9, "neither a text table nor Parquet"),
        ("t.csv", b"PAR1" + bytes(100), "damaged"),
        ("t.parquet", b"hello", "damaged"),
        ("t.csv", b"a,b\n1\n2\n", "number of cells"),
    ],
)
def test_unusable_files_are_named(tmp_path, name, content, words):
    with pytest.raises(DataError, match=words) as caught:
        table(tmp_path, content, name)
    assert name in str(caught.value)


def test_missing_file_and_folder(tmp_path):
    with pytest.raises(DataError, match="no such file"):
        read_table(tmp_path / "nope.csv")
    with pytest.raises(DataError, match="folder"):
        read_table(tmp_path)


def test_a_column_named_twice_is_refused_when_it_is_used(tmp_path):
    read = table(tmp_path, "a,b,b\n1,2,3\n")
    assert read.numbers("a").value == [1.0]
    with pytest.raises(DataError, match="more than once"):
        read.numbers("b")


def test_problems_beyond_the_limit_are_summed_up(tmp_path):
    (tmp_path / "t.csv").write_text("a,b\n1,2\n" + "3\n" * 50)
    problems = read_table(tmp_path / "t.csv", max_problems=10).problems
    assert len(problems) == 11
    assert sum(p.rows for p in problems) == 50
    assert problems[-1].row == 13


def test_many_rows_are_read_quickly(tmp_path):
    lines = "\n".join(f"{i * 0.1:.3f},1.25e-5,-2.5e-5,3.125e-5" for i in range(200_000))
    (tmp_path / "t.csv").write_text("time_s,x,y,z\n" + lines)
    start = time.process_time()
    read = read_table(tmp_path / "t.csv")
    total = sum(read.numbers(name).value.sum() for name in "xyz")
    assert time.process_time() - start < 5.0  # 0.5 s when idle; a row-by-row reader takes longer
    assert total == pytest.approx(200_000 * 1.875e-5)
