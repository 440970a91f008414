"""`companion report`: a recorded flight as one page that works offline, and as figures.

`flight.of` reads the figures out of a recording, `series.of` what is drawn, `page.write` makes the page.
"""
