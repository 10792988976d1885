"""The files of `lingo-mi batch` in out/ of a folder."""

import csv

BATCH = 'batch'


def results(home):
    with open(home / 'out' / 'results.csv', newline='') as file:
        return {row['name']: row for row in csv.DictReader(file)}


def events(home, kind=''):
    """Lines of the log, without their times, that begin with this."""
    lines = (line.partition(' ')[2] for line in (home / 'out' / 'batch.log').read_text().splitlines())
    return [line for line in lines if line.startswith(kind)]
