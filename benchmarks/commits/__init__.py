"""One commit of the library against another: the same numbers, and as fast?"""
