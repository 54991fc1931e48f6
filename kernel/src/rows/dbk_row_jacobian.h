/* Rows in joint space: the product n'J of every row. */
#ifndef DBK_ROW_JACOBIAN_H
#define DBK_ROW_JACOBIAN_H

#include "dbk_math.h"

/* sets rows->a from the normals and the spheres of the rows; `square` and `total` receive sum_k a_k^2 and sum_k
 * |a_k| */
void dbk_row_jacobian(const dbk_model *model, const dbk_ctx *ctx, dbk_rows *rows, dbk_real *square, dbk_real *total);

#endif
