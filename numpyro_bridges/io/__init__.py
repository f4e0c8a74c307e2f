"""Reading and writing of landmarks and outlines: tpsDig files and CSV tables, as lists of `Specimen`."""

from ._csv import read_csv as read_csv, write_csv as write_csv
from ._specimen import Specimen as Specimen
from ._tps import read_tps as read_tps, write_tps as write_tps
