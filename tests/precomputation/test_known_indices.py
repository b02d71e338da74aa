"""A rigorous table is for wavelengths inside of the medium above, an index for those in air."""

import pytest

from mitsuba_diffraction.errors import RequestError
from mitsuba_diffraction.precomputation.spectra import check_index_range
from mitsuba_diffraction.precomputation.surface_text import parsed
from mitsuba_diffraction.settings import Settings


@pytest.mark.parametrize("ext_ior", [1.0, 1.25, 1.5])
def test_an_index_must_be_known_at_the_wavelengths_in_air(ext_ior, tmp_path):
    table = tmp_path / "metal.csv"
    table.write_text("wl,n,k\n" + "".join(f"{w / 1000},1.2,6.5\n" for w in range(400, 701, 10)))

    def check(first, last):
        wavelengths = first / ext_ior, last / ext_ior
        check_index_range(Settings.of(theory="rigorous", material=str(table), ext_ior=ext_ior, wavelengths=wavelengths))

    check(401, 699)
    for outside in ((380, 699), (401, 730)):
        with pytest.raises(RequestError, match=r"material: got light of"):
            check(*outside)


def test_a_value_is_the_longest_name_of_a_file(tmp_path):
    names = [tmp_path / name for name in ("n.spd", "n.spd,1.spd", "n.spd,1.spd,2.spd")]
    for name in names:
        name.touch()
        assert parsed(f"blazed,int_ior={name},period=2.5") == ("blazed", {"int_ior": str(name), "period": 2.5})
