from .claims import check_claims as check_claims
from .page import Figure as Figure
from .page import Page as Page
from .page import Table as Table
from .page import write_page as write_page
from .runs import Settings as Settings
from .runs import run_paper as run_paper
