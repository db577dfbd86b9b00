"""Local frames, against PROJ."""

import numpy as np
import pytest
from pyproj import CRS, Transformer

from segslam.gnss.geodesy import Origin, enu_from_geodetic, geodetic_from_enu, utm_epsg

ORIGINS = [
    Origin(48.98, 8.39, 115.0),
    Origin(-33.9, 151.2, 20.0),
    Origin(17.0, 179.9999, 5.0),  # beside the date line
    Origin(0.0, -180.0, 0.0),
    Origin(89.9, 10.0, 2.0),
    Origin(48.0, 11.99999, 400.0),  # beside the edge of a UTM zone
]


@pytest.mark.parametrize("origin", ORIGINS, ids=str)
def test_local_coordinates_are_those_of_proj_and_return(origin: Origin) -> None:
    enu_m = np.random.default_rng(0).uniform(-3000.0, 3000.0, (50, 3)) * [1.0, 1.0, 0.05]
    places = geodetic_from_enu(enu_m, origin)
    topocentric = Transformer.from_pipeline(
        "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step +proj=cart +ellps=WGS84 +step "
        f"+proj=topocentric +ellps=WGS84 +lat_0={origin.latitude_deg} +lon_0={origin.longitude_deg} "
        f"+h_0={origin.height_m}"
    )
    theirs = np.column_stack(topocentric.transform(places[:, 1], places[:, 0], places[:, 2]))
    np.testing.assert_allclose(theirs, enu_m, atol=1e-4)
    np.testing.assert_allclose(enu_from_geodetic(places, origin), enu_m, atol=1e-6)
    assert (np.abs(places[:, 1]) <= 180.0).all()


@pytest.mark.parametrize(
    ("latitude", "longitude"),
    [
        (48.98, 8.39),
        (-33.9, 151.2),
        (60.4, 5.3),
        (78.2, 15.6),
        (17.0, 179.99),
        (17.0, -179.99),
        (0.0, 180.0),
        (56.1, 2.9),
    ],
)
def test_the_utm_zone_is_that_of_proj(latitude: float, longitude: float) -> None:
    area = CRS.from_epsg(utm_epsg(latitude, longitude)).area_of_use
    assert area is not None
    wrapped = (longitude + 180.0) % 360.0 - 180.0
    if (latitude, longitude) not in ((60.4, 5.3), (78.2, 15.6)):  # wider zones in Norway and Svalbard
        assert area.west <= wrapped <= area.east
    assert area.south <= latitude <= area.north


def test_the_zones_of_norway_and_svalbard_are_wider() -> None:
    assert utm_epsg(60.4, 5.3) == 32632
    assert utm_epsg(78.2, 15.6) == 32633
    assert utm_epsg(85.0, 0.0) == 32661
