"""Batch rendering: draws the jobs of a table with several worker processes.

A batch may have millions of jobs and run for days, so it must survive crashes, hangs, full disks
and interruptions. A table flows in: ``tables`` reads its rows, and ``jobs`` makes chunks of jobs
from them. ``records`` compares the chunks with the output folder. ``supervisor`` sends the
remaining chunks to processes of ``worker``, which draw ``outputs``. Files and records flow out.

One rule holds inside: the key of a job is a digest of its tables, its input files and the code, and
a job's files depend only on its key. Each file is written atomically, and the record of a chunk
last. Therefore any number of workers gives the same bytes, and the same command resumes a batch.
"""
