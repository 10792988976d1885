"""Jobs one by one in this process."""

from __future__ import annotations

from lingo_mi.common.progress import Progress
from lingo_mi.jobs.job import Event, Job, Tell, attempt


class InProcess:
    """A `Runner` with a progress bar for each job."""

    def run(self, jobs: list[Job], tell: Tell) -> None:
        for i, job in enumerate(jobs, 1):
            tell(Event(job.name, 'began', 'this process'))
            with Progress(f'[{i}/{len(jobs)}] {job.name}', job.steps) as bar:
                ended = attempt(job, bar.update, tell)
            tell(ended)
