// Pool of result arrays: an array that Python no longer references is reused, because an allocation takes longer than a
// copy.
#ifndef DBK_RESULT_POOL_H
#define DBK_RESULT_POOL_H

#include <nanobind/nanobind.h>

// two arrays, used alternately: the caller usually still holds the last result during the next step
struct ResultPool {
  nanobind::object array[2];
  unsigned next = 0;
};

#endif
