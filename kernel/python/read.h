// From Python's description of a body and of obstacles to the kernel's.
#ifndef DBK_READ_H
#define DBK_READ_H

#include <nanobind/nanobind.h>

#include "dbk/dbk.h"

// std::invalid_argument where a size does not fit
void read_model(const nanobind::dict &d, dbk_model *model);

// one row of the obstacle table
constexpr size_t kObstacle = 29;
void read_obstacle(const double *row, dbk_obstacle *o);

#endif
