"""Values: settings as records of fields, as tables, and as vectors.

Users write settings in Python, in scene files, in rows of a batch, and as options. All become
the same records, whose fields state what they accept, after the sources of one job are merged as
tables (``fields``). A value is checked once, at this border, by the constructor of its
record; everything behind it trusts the record. ``vectors`` has the ranges and the few operations of
vectors that several packages share."""
