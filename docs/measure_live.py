"""What a live page that is looked at costs a fit.

pip install -e .
python docs/measure_live.py

Fits of the foot with and without a page, in turns, by the CPU time of the process that fits, which other work disturbs least. The
page is a process that asks as the page does, every second, and reads the answers.
"""

import contextlib
import io
import json
import re
import statistics
import subprocess
import sys
import time

import lingo_mi as lm

TURNS, ITERATIONS = 3, 200
VIEWER = """
import json, sys, time, urllib.request
address, seen, place = sys.argv[1], 0, ''
while True:
    try:
        state = json.loads(urllib.request.urlopen(f'{address}&seen={seen}&history={place}', timeout=30).read())
    except OSError:
        break
    seen, place = state['number'], state['history']['place']
    if state['done']:
        break
    time.sleep(1)
print(seen)
"""


class Viewed(io.StringIO):
    """Standard error, which looks at the page whose address is written to it."""

    viewer = None

    def write(self, text: str) -> int:
        if found := re.match(r'live: (\S+)\?(token=\S+)', text):
            command = [sys.executable, '-c', VIEWER, f'{found[1]}state?{found[2]}']
            self.viewer = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        return super().write(text)


def main() -> None:
    data = lm.simulate('x3d_foot', progress=False)
    times: dict[bool, list[float]] = {False: [], True: []}
    for turn in range(TURNS + 1):
        for live, taken in times.items():
            began = time.process_time()
            with contextlib.redirect_stderr(Viewed()) as shown:
                lm.fit(data, 'fast', iterations=ITERATIONS, live=live, progress=False)
            if turn:  # the first one compiles
                taken.append(time.process_time() - began)
            if shown.viewer:
                print(f'states seen: {json.loads(shown.viewer.communicate()[0])}')
    costs = [100 * (seen / plain - 1) for plain, seen in zip(times[False], times[True])]
    plain = statistics.median(times[False])
    print(
        f'{plain:.1f} s of CPU; with a page {statistics.median(costs):+.1f} %, in turns {[f"{c:+.1f}" for c in costs]}'
    )


if __name__ == '__main__':
    main()
