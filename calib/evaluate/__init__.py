"""Is a ceiling good for the daemon, and is a calibration still good?"""
