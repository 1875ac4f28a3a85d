"""The reference study: figures of Gail, Leyendecker and Ober-Bloebaum (2014), run again and held against the paper."""
