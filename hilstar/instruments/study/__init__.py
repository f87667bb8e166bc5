"""Studies: what each choice costs in accuracy and in time, and where methods fail.

`hilstar study NAME` runs NAME.py, or run.py in the folder NAME. A study measures rows, writes them
as a table and draws charts of them (engine.py). There are three kinds:

- trials, which are methods with an error and a time (trials.py): tradeoff, chain; and with rows of
  their own bodies, colour, economy, faults, prediction, quantisation and timing;
- failing cases: stability (`FailureCase`) and limits (`StressLimit`);
- tables against somebody else's: models and outputs (the thesis), rigs (published rigs), confront
  (photographs) and geometry (traced rays).

No study imports another, and only `hilstar.cli` imports studies. Times are taken in turn
(sweep.py), and name no winner on a busy machine (`Load`).
"""
