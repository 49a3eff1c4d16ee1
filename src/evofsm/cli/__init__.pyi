from .app import application as application
from .options import imported as imported
from .show import print_json as print_json
from .show import print_page as print_page
