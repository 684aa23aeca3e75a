"""A fuzzer of every reader: small files (``seeds.py``) changed at random, by their structure and by
their bytes (``mutate.py``), read and drawn, and what comes of them judged (``subjects.py``).
``python -m tools.fuzz`` runs it, guided by coverage."""
