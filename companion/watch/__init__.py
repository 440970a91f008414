"""`companion watch`: vehicles as they tell of themselves on Zenoh, in a terminal or on a page.

`fleet` keeps what was heard, `terminal` prints it, `server` and `page.*` show it in a browser.
"""
