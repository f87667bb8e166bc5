"""The table beside the list: which satellites it brightens, and what is wrong in some."""

from __future__ import annotations

import numpy as np
import pytest

from hilstar.basics.errors import InputError
from hilstar.sky.bodies.satellites import brightness_of, read_satellites, read_table
from tests.support.satellites import element_set
from tests.support.skies import STATION_TLE


def test_each_satellite_has_its_row_and_others_the_default():
    found = read_satellites(STATION_TLE + element_set(7, (0.0, 0.0, 0.0, 0.0), 0.0, 1.0027), "f", 0)
    text = (
        "# seen\nNORAD,"
        " standard_mag,period_s,amplitude_mag,size_m\r\n25544,-1.8,,,109\n\n00099,3,1,2,\n"
    )
    light = brightness_of(found, read_table(text, "table.csv"), 6.0, 1000.0)
    assert np.allclose(
        light.standard_e_per_s, 1000.0 * 10 ** (-0.4 * np.array([-1.8, 6.0])), rtol=1e-12
    )
    assert light.size_m.tolist() == [109.0, 0.0]
    assert np.isnan(light.period_s).all()


def test_a_row_is_of_a_number_as_lists_write_it_and_has_what_stands_there_at_its_limits():
    """Alpha-5: A0001 is 100001, Z9999 is 339999 (Space-Track), without I and O."""
    text = (
        "norad,standard_mag,period_s,amplitude_mag,flash_s,flash_at_s,size_m\n"
        "A0001,-30,0.2,20,0.1,-1e10,1e5\nZ9999,50,,,,,0\n799500123,,,,,,2.5\n25544,,7,1,,,\n"
    )
    assert read_table(text, "table.csv") == {
        100_001: {
            "standard_mag": -30.0,
            "period_s": 0.2,
            "amplitude_mag": 20.0,
            "flash_s": 0.1,  # half of the period: the longest
            "flash_at_s": -1e10,
            "size_m": 1e5,
        },
        339_999: {"standard_mag": 50.0, "size_m": 0.0},
        799_500_123: {"size_m": 2.5},
        25_544: {"period_s": 7.0, "amplitude_mag": 1.0},
    }


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", r"table\.csv:1: no header with norad"),
        ("25544,-1.8\n", r"table\.csv:1: no header with norad and each column once"),
        ("norad,mag\n", r"no column 'mag' is known"),
        ("norad,norad\n", r"column norad is there twice"),
        ("norad,size_m\n5\n", r":2: 1 cells and 2 columns"),
        ("norad\nISS\n", r"table\.csv:2: norad = 'ISS'; write a catalogue number"),
        ("norad\n\n5\n5\n", r"table\.csv:4: satellite 5 is there twice"),
        ("norad,standard_mag\n5,bright\n", r"table\.csv:2: standard_mag = 'bright'"),
        ("norad,standard_mag\n5,nan\n", r"standard_mag = 'nan'"),
        ("norad,standard_mag\n5,1,2\n", r":2: 3 cells and 2 columns"),
        ("norad,period_s\n5,3\n", r"a period_s and an amplitude_mag"),
        ("norad,amplitude_mag\n5,3\n", r"a period_s and an amplitude_mag"),
        ("norad,flash_s\n5,3\n", r"a period_s and an amplitude_mag"),
        ("norad,size_m\n5,-1\n", r"size_m = '-1'; write 0 to 100000, or leave it empty"),
        ("norad,standard_mag\n5,50.1\n", r"standard_mag = '50.1'; write -30 to 50"),
        ("norad,period_s,amplitude_mag\n5,0,1\n", r"period_s = '0'"),
        ("norad,period_s,amplitude_mag,flash_s\n5,1,2,0.6\n", r"flash_s is over half of period_s"),
        ('norad\n"5\n', r"table\.csv:2: "),
    ],
)
def test_a_wrong_row_is_named(text, said):
    with pytest.raises(InputError, match=said):
        read_table(text, "table.csv")
