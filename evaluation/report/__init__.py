"""``make report``: runs the evaluations that are out of date, and writes docs/results.md."""
