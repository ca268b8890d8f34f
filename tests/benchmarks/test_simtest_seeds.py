"""The table of many simulated runs: a row for each block, none made twice."""

import csv

import simtest_seeds


def test_a_block_of_seeds_is_a_row_and_is_not_made_again(tmp_path, capsys):
    out = tmp_path / 'seeds.csv'
    assert simtest_seeds.main(['--end', '3', '--block', '2'], out) == 0
    with out.open() as file:
        rows = list(csv.DictReader(file))
    assert [(row['first'], row['last'], row['failed']) for row in rows] == [
        ('0', '1', '0'),
        ('2', '2', '0'),
    ]
    assert all(row['commit'] and row['torch'] for row in rows)
    capsys.readouterr()
    assert simtest_seeds.main(['--end', '3', '--block', '2'], out) == 0
    assert capsys.readouterr().out == ''
