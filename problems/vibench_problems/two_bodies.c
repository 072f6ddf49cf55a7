/* The condition on cells below and a grid above that the radius mu[0] scales, for the approach mu[1]: products of integrals
 * of hat functions along both axes; see two_bodies.py. */
static int contact(const double *mu, int *ends, int *columns, double *values, double *g)
{
    double hats[contact_hats];
    int first[contact_cells], after[contact_cells + 1] = { 0 }, next = 0, node = 0;
    if (!(mu[0] * contact_above[contact_nodes - 1] >= contact_below[contact_cells] * (1.0 - contact_covered))) return 0;
    for (int i = 0; i < contact_cells; i++) {
        double from = contact_below[i];
        int count = 0;
        while (from < contact_below[i + 1]) {
            double begin, end, to, right;
            while (node < contact_nodes - 2 && mu[0] * contact_above[node + 1] <= from) node++;
            begin = mu[0] * contact_above[node];
            end = mu[0] * contact_above[node + 1];
            to = node == contact_nodes - 2 ? contact_below[i + 1] : fmin(contact_below[i + 1], end);
            if (!count) first[i] = node;
            for (; count < node + 2 - first[i]; count++) hats[after[i] + count] = 0.0;
            right = (to - from) * (0.5 * (from + to) - begin) / (end - begin);
            hats[after[i] + count - 2] += to - from - right;
            hats[after[i] + count - 1] += right;
            from = to;
        }
        after[i + 1] = after[i] + count;
    }
    for (int i = 0; i < contact_cells * contact_cells; i++) {
        const int x = i / contact_cells, y = i % contact_cells;
        g[i] = contact_gap[i] - mu[1] * contact_areas[i];
        for (int k = contact_slave_ends[i]; k < contact_slave_ends[i + 1]; k++) {
            columns[next] = contact_slave_columns[k];
            values[next++] = contact_slave_values[k];
        }
        for (int a = after[x]; a < after[x + 1]; a++)
            for (int b = after[y]; b < after[y + 1]; b++) {
                const int above = (first[x] + a - after[x]) * contact_nodes + first[y] + b - after[y];
                columns[next] = contact_slaves + above;
                values[next++] = hats[a] * hats[b];
                g[i] += hats[a] * hats[b] * mu[0] * contact_height[above];
            }
        ends[i + 1] = next;
    }
    return 1;
}
