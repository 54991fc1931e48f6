/* Quadratic program of the filter. */
#ifndef DBK_QP_H
#define DBK_QP_H

#include "dbk_math.h"

/* solves the QP from the active set `warm` (ids as in dbk_solution.active); `with_slack` adds one slack with the
 * coefficients rows->soft; the rows are tightened by `shift`. Returns 0: solved, 1: infeasible, 2: iteration limit */
int32_t dbk_qp(const dbk_rows *rows, int32_t n, const dbk_real scale[DBK_MAX_DOF][DBK_MAX_DOF],
               const dbk_real lower[DBK_MAX_DOF], const dbk_real upper[DBK_MAX_DOF], const dbk_real u_nom[DBK_MAX_DOF],
               int32_t with_slack, dbk_real shift, const int32_t *warm, int32_t n_warm, dbk_solution *solution);

#endif
