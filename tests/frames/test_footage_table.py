"""The table of the documentation says what happens."""

from tests.footage_table import table, written


def test_the_table_of_the_documentation_is_up_to_date(tmp_path):
    assert table(tmp_path) == written()  # if not: python -m tests.footage_table
