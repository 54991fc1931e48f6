/* Warm start of the QP: the active constraints of the previous step. */
#ifndef DBK_WARM_START_H
#define DBK_WARM_START_H

#include "dbk_math.h"

/* writes the constraint ids of the warm start in the numbering of the current rows; returns their number */
int32_t dbk_warm_start_load(const dbk_model *model, const dbk_ctx *ctx, int32_t ids[DBK_QP_DIM]);

/* reports the active constraints of the solution in `out`, and stores them as the next warm start */
void dbk_warm_start_store(const dbk_model *model, dbk_ctx *ctx, dbk_out *out);

#endif
