"""Where on a map of a whole building is what one view shows? Look-up of rare features, verified by all of them."""
