"""Reading and writing of landmarks and outlines as lists of `Specimen`: files of tpsDig, CSV
tables, 3D Slicer, NTS and Morphologika; sets of specimens as arrays, and with what a second table
says of them."""

from ._csv import read_csv as read_csv, write_csv as write_csv
from ._morphologika import read_morphologika as read_morphologika
from ._nts import read_nts as read_nts
from ._read import read as read
from ._sets import Stack as Stack, join as join, stack as stack
from ._slicer import read_slicer as read_slicer
from ._specimen import Specimen as Specimen
from ._tps import read_tps as read_tps, write_tps as write_tps
