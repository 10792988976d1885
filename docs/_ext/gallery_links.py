"""Links to an example's source lead to its page in the site, so that the same link works where the sources are read."""

import re


def _lead_to_pages(app, name: str, source: list[str]) -> None:
    source[0] = re.sub(r'\]\(\.\./((?:\.\./)*)examples/(\w+)\.py\)', r'](\1gallery/\2.rst)', source[0])
    source[0] = re.sub(r'\]\(\.\./((?:\.\./)*)examples/README\.rst\)', r'](\1gallery/index.rst)', source[0])


def setup(app):
    app.connect('source-read', _lead_to_pages)
    return {'parallel_read_safe': True}
