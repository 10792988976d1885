"""A process that has loaded everything and runs commands in children, so that one takes half a second: see `Server`.

As a program it reads one request a line from its standard input, as JSON, and answers each by a line.
"""

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path


class Server:
    """A context of `run(task, arguments, folder, at, kind)`: exit status, standard error and the number of calls that write.

    task        'fit', 'reconstruct', 'tables', or 'save': `load_fit(arguments[0]).save(arguments[1], force=True)`
    folder      below which calls are counted; None: none are
    at, kind    see `write_faults.Faults`; its `failed`, of the last command, is an attribute
    """

    def __enter__(self):
        paths = os.pathsep.join([str(Path(__file__).parents[1]), os.environ.get('PYTHONPATH', '')])
        environment = os.environ | dict(PYTHONPATH=paths, OPENBLAS_NUM_THREADS='1', OMP_NUM_THREADS='1')
        environment['CUDA_VISIBLE_DEVICES'] = ''  # a forked process cannot use a GPU that its parent has begun to use
        self.process = subprocess.Popen(
            [sys.executable, '-m', 'helpers.fault_server'], stdin=-1, stdout=-1, text=True, env=environment
        )
        return self

    def run(self, task, arguments, folder=None, at=None, kind='kill'):
        request = dict(task=task, arguments=[*map(str, arguments)], folder=folder and str(folder), at=at, kind=kind)
        print(json.dumps(request), file=self.process.stdin, flush=True)
        answer = json.loads(self.process.stdout.readline())
        self.failed = answer['failed']
        return answer['code'], answer['err'], answer['calls']

    def __exit__(self, *_):
        self.process.stdin.close()
        self.process.wait()
        self.process.stdout.close()


def work(request, calls):
    """In a child: run the command and exit."""
    from unittest import mock

    import lingo_mi as lm
    from helpers.write_faults import Faults
    from lingo_mi.cli import fit, reconstruct
    from lingo_mi.cli.common import guard
    from lingo_mi.common.runtime import use_variant
    from lingo_mi.validation.tables import cells
    from studies import tables

    def save():
        use_variant('llvm_ad_mono')
        lm.load_fit(arguments[0]).save(arguments[1], force=True)

    arguments = request['arguments']
    sys.argv = [request['task'], *arguments, '--variant', 'llvm_ad_mono']
    cells.SCANNED, cells.SCALES['small'] = 6, cells.Scale(8, 12, 40, (3,), ('foot',))
    faults = Faults(request['folder'] or '/nowhere', request['at'], request['kind'])
    mains = dict(fit=fit.main, reconstruct=reconstruct.main, tables=tables.main, save=save)
    try:
        # Drawing takes longer than all else; what is drawn is written as ever.
        with (
            mock.patch('lingo_mi.report.figures.overview', return_value=b'a picture'),
            mock.patch('lingo_mi.report.page.report_page', return_value='a page'),
        ):
            faults.install()
            guard(mains[request['task']])
    finally:
        os.pwrite(calls, json.dumps(dict(calls=faults.count, failed=faults.failed)).encode(), 0)


def serve():
    import nibabel  # noqa: F401 - loaded once for all children
    import skimage.metrics  # noqa: F401

    import lingo_mi.fitting.save
    import lingo_mi.scene.load
    import lingo_mi.validation.tables.report  # noqa: F401
    import studies.tables  # noqa: F401
    from lingo_mi.cli import fit, reconstruct  # noqa: F401

    answers = os.dup(1)
    for line in sys.stdin:
        with tempfile.TemporaryFile() as calls, tempfile.TemporaryFile() as err:
            child = os.fork()
            if not child:
                os.dup2(err.fileno(), 2)
                os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
                code = 1
                try:
                    work(json.loads(line), calls.fileno())
                except SystemExit as stop:
                    code = stop.code or 0
                except BaseException:
                    import traceback

                    traceback.print_exc()
                sys.stderr.flush()
                os._exit(code)
            status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
            calls.seek(0)
            err.seek(0)
            text = err.read().decode(errors='backslashreplace')
            answer = dict(code=status, err=text) | json.loads(calls.read() or '{"calls": 0, "failed": []}')
            os.write(answers, (json.dumps(answer) + '\n').encode())


if __name__ == '__main__':
    serve()
