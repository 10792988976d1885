"""A Dask scheduler and workers as processes of this machine, as a user starts them."""

import contextlib
import os
import subprocess
import sys
import time

# Workers that draw no report, which takes longer than a tiny fit.
PRELOAD = 'import lingo_mi\nfrom lingo_mi.fitting import save\nsave.write_report = lambda *_: None\n'


@contextlib.contextmanager
def cluster(folder, workers, threads_of_tasks=1):
    """Yields the scheduler's file, and a function that gives the workers' process numbers by address."""
    import distributed

    file, preload = folder / 'scheduler.json', folder / 'preload.py'
    preload.write_text(PRELOAD)
    common = ['--scheduler-file', file]
    scheduler = ['distributed.cli.dask_scheduler', *common, '--host', '127.0.0.1', '--port', '0', '--no-dashboard']
    worker = ['distributed.cli.dask_worker', *common, '--nthreads', threads_of_tasks, '--no-nanny', '--no-dashboard']
    worker += ['--host', '127.0.0.1', '--memory-limit', '0', '--preload', preload, '--local-directory', folder]
    with contextlib.ExitStack() as stack:

        def start(module, *arguments):
            with open(folder / 'log', 'a') as log:
                process = subprocess.Popen(
                    [sys.executable, '-m', module, *map(str, arguments)], stdout=log, stderr=log, cwd=folder
                )
            stack.callback(process.wait)
            stack.callback(process.kill)

        start(*scheduler)
        wait_until(file.exists)
        for _ in range(workers):
            start(*worker)

        def processes():
            with distributed.Client(scheduler_file=str(file), set_as_default=False) as client:
                return client.run(os.getpid)

        wait_until(lambda: len(processes()) == workers)
        yield file, processes


def wait_until(true, seconds=300):
    ends = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < ends, 'it never came about'
        time.sleep(0.05)
