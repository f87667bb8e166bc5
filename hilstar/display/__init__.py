"""Light to levels, codes and a panel: where the monitor's pixels are, what light its codes make,
how they are drawn.
"""
