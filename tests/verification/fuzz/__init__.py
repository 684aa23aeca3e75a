"""A fuzzer of every reader. It mutates the structure and the bytes (``mutate.py``) of small files
(``seeds.py``), reads and draws them, and checks the results (``subjects.py``).
``python -m tools.fuzz`` runs it guided by coverage."""
