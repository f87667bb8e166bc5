"""The error budget of a star tracker: bias, field-of-view error, pixel error, noise, clock and
wrong answers.

`hilstar assess` reads a run's ledger and the tracker's telemetry (`assessment.assess_files`) and
writes the budget as tables and one page (`report`). The budget itself is NumPy and SciPy: arrays
in, a `Decomposed` out. Angles are in arcsec, attitudes unit q_icrs_to_cam (w, x, y, z), errors in
cam axes.

- `budget.assess_run(commanded, tau_s, reported, coarse, scale, rng)`: a tracker's telemetry on its
  own clock, against a `Commanded(t_s, q)`; `clock.coarse_offset(commanded, tau_s, reported)` finds
  where it lies on the run's clock.
- `budget.assess_cases(commanded, reported, scale, rng[, rate_rad_s])`: independent cases, arrays
  (n, 4); a row of NaN in `reported` is a case without an answer. `Scale(focal_px, (width, height))`
  is the tracker's.
- `Decomposed.bias_arcsec` (3,), `.fov_arcsec`, `.pixel_arcsec`, `.noise_arcsec` (`Axes(cross,
  roll)`, one sigma per axis, None where the run does not tell, with the reason in `.notes`),
  `.intervals` (95 %), `.wrong` and `.row` (indices of the wrong and the right answers),
  `.components.left` (k, 3), the noise of each right answer.
"""
