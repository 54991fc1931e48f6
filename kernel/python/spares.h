// Arrays that were answers: one that nobody else holds any more is filled again, as making one takes longer than that.
#ifndef DBK_SPARES_H
#define DBK_SPARES_H

#include <nanobind/nanobind.h>

// two in turn: as a rule the last answer is held while the next one is made
struct Spares {
  nanobind::object array[2];
  unsigned turn = 0;
};

#endif
