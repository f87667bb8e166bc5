"""The monitor: where its pixels are in the tracker's field, and what light its codes make."""
