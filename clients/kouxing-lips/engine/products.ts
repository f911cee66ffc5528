// Matrix products with SIMD. All pointers are byte offsets into the memory; matrices are stored in row-major order.
// This is AssemblyScript (https://www.assemblyscript.org), not TypeScript; products.js contains the compiled code.

const FLOAT_BYTES = 4;

/** Return the sums of the lanes of four vectors of integers. */
function sumIntegers(a: v128, b: v128, c: v128, d: v128): v128 {
  const ab = i32x4.add(v128.shuffle<i32>(a, b, 0, 4, 1, 5), v128.shuffle<i32>(a, b, 2, 6, 3, 7));
  const cd = i32x4.add(v128.shuffle<i32>(c, d, 0, 4, 1, 5), v128.shuffle<i32>(c, d, 2, 6, 3, 7));
  return i32x4.add(v128.shuffle<i64>(ab, cd, 0, 2), v128.shuffle<i64>(ab, cd, 1, 3));
}

/** Return the sums of the lanes of four vectors of floats. */
function sumFloats(a: v128, b: v128, c: v128, d: v128): v128 {
  const ab = f32x4.add(v128.shuffle<f32>(a, b, 0, 4, 1, 5), v128.shuffle<f32>(a, b, 2, 6, 3, 7));
  const cd = f32x4.add(v128.shuffle<f32>(c, d, 0, 4, 1, 5), v128.shuffle<f32>(c, d, 2, 6, 3, 7));
  return f32x4.add(v128.shuffle<f64>(ab, cd, 0, 2), v128.shuffle<f64>(ab, cd, 1, 3));
}

/** Add the products of eight 16-bit integers and eight 8-bit weights. */
function addDot(sum: v128, x: v128, weights: usize, offset: usize = 0): v128 {
  return i32x4.add(sum, i32x4.dot_i16x8_s(x, v128.load_ext<i8>(weights + offset)));
}

/** Add the products of four floats. */
function addProduct(sum: v128, a: v128, b: usize, offset: usize = 0): v128 {
  return f32x4.add(sum, f32x4.mul(a, v128.load(b + offset)));
}

/** Add a coefficient of a polynomial (Horner's method). */
function addTerm(sum: v128, x: v128, coefficient: f32): v128 {
  return f32x4.add(f32x4.splat(coefficient), f32x4.mul(x, sum));
}

/** Multiply one row and four columns. */
function multiplyRow(x: usize, w0: usize, scales: usize, out: usize, size: usize): void {
  const w1 = w0 + size, w2 = w1 + size, w3 = w2 + size;
  let s0 = i32x4.splat(0), s1 = s0, s2 = s0, s3 = s0;
  for (let at: usize = 0; at < size; at += 16) {
    const a = v128.load(x + 2 * at), b = v128.load(x + 2 * at, 16);
    s0 = addDot(addDot(s0, a, w0 + at), b, w0 + at, 8);
    s1 = addDot(addDot(s1, a, w1 + at), b, w1 + at, 8);
    s2 = addDot(addDot(s2, a, w2 + at), b, w2 + at, 8);
    s3 = addDot(addDot(s3, a, w3 + at), b, w3 + at, 8);
  }
  v128.store(out, f32x4.mul(v128.load(scales), f32x4.convert_i32x4_s(sumIntegers(s0, s1, s2, s3))));
}

/** Multiply two rows and four columns. */
function multiplyRows(x0: usize, w0: usize, scales: usize, out: usize, size: usize, columns: i32): void {
  const w1 = w0 + size, w2 = w1 + size, w3 = w2 + size, x1 = x0 + 2 * size;
  let s0 = i32x4.splat(0), s1 = s0, s2 = s0, s3 = s0, t0 = s0, t1 = s0, t2 = s0, t3 = s0;
  for (let at: usize = 0; at < size; at += 8) {
    const a = v128.load(x0 + 2 * at), b = v128.load(x1 + 2 * at);
    s0 = addDot(s0, a, w0 + at);
    t0 = addDot(t0, b, w0 + at);
    s1 = addDot(s1, a, w1 + at);
    t1 = addDot(t1, b, w1 + at);
    s2 = addDot(s2, a, w2 + at);
    t2 = addDot(t2, b, w2 + at);
    s3 = addDot(s3, a, w3 + at);
    t3 = addDot(t3, b, w3 + at);
  }
  const scale = v128.load(scales);
  v128.store(out, f32x4.mul(scale, f32x4.convert_i32x4_s(sumIntegers(s0, s1, s2, s3))));
  v128.store(out + FLOAT_BYTES * columns, f32x4.mul(scale, f32x4.convert_i32x4_s(sumIntegers(t0, t1, t2, t3))));
}

/**
 * Multiply 8-bit integers and scale the columns. x: (rows, size) int16, size a multiple of 8; weights:
 * (columns, size) int8; scales: (columns,) float; out: (rows, columns) float. The last four columns may
 * be computed twice.
 */
export function multiplyBytes(x: usize, weights: usize, scales: usize, out: usize, rows: i32, size: i32, columns: i32): void {
  for (let column = 0; column < columns; column += 4) {
    const place = min(column, columns - 4);
    const w = weights + place * size;
    const s = scales + FLOAT_BYTES * place;
    for (let row = 0; row < rows; row += 2) {
      const a = x + 2 * row * size;
      const o = out + FLOAT_BYTES * (row * columns + place);
      if (row + 1 < rows) multiplyRows(a, w, s, o, size, columns);
      else multiplyRow(a, w, s, o, size);
    }
  }
}

/**
 * Multiply a, (rows, size), the transpose of b, (columns, size), and a factor, all float, size a multiple
 * of 4. out: (rows, columns) float
 */
export function multiplyTransposed(a: usize, b: usize, out: usize, rows: i32, size: i32, columns: i32, factor: f32): void {
  const bytes = FLOAT_BYTES * size;
  for (let row = 0; row < rows; row++, a += bytes) {
    for (let column = 0; column < columns; column += 4) {
      const place = min(column, columns - 4);
      const b0 = b + place * bytes, b1 = b0 + bytes, b2 = b1 + bytes, b3 = b2 + bytes;
      let s0 = f32x4.splat(0), s1 = s0, s2 = s0, s3 = s0;
      for (let at = 0; at < bytes; at += 16) {
        const v = v128.load(a + at);
        s0 = addProduct(s0, v, b0 + at);
        s1 = addProduct(s1, v, b1 + at);
        s2 = addProduct(s2, v, b2 + at);
        s3 = addProduct(s3, v, b3 + at);
      }
      v128.store(out + FLOAT_BYTES * (row * columns + place), f32x4.mul(f32x4.splat(factor), sumFloats(s0, s1, s2, s3)));
    }
  }
}

/** Multiply a, (rows, size), and b, (size, columns), both float, with 16 columns or more. out: (rows, columns) float */
export function multiply(a: usize, b: usize, out: usize, rows: i32, size: i32, columns: i32): void {
  const bytes = FLOAT_BYTES * columns;
  for (let row = 0; row < rows; row++, a += FLOAT_BYTES * size, out += bytes) {
    for (let column = 0; column < columns; column += 16) {
      const place = FLOAT_BYTES * min(column, columns - 16);
      let s0 = f32x4.splat(0), s1 = s0, s2 = s0, s3 = s0;
      for (let i = 0, from = b + place; i < size; i++, from += bytes) {
        const v = v128.load32_splat(a + FLOAT_BYTES * i);
        s0 = addProduct(s0, v, from);
        s1 = addProduct(s1, v, from, 16);
        s2 = addProduct(s2, v, from, 32);
        s3 = addProduct(s3, v, from, 48);
      }
      v128.store(out + place, s0);
      v128.store(out + place, s1, 16);
      v128.store(out + place, s2, 32);
      v128.store(out + place, s3, 48);
    }
  }
}

/** Divide four numbers by a scale, round half to even, and clip. */
function toIntegers(x: usize, scale: v128, lowest: v128, highest: v128): v128 {
  const rounded = f32x4.nearest(f32x4.div(v128.load(x), scale));
  return i32x4.trunc_sat_f32x4_s(f32x4.min(highest, f32x4.max(lowest, rounded)));
}

/**
 * Divide rows by their scales, round half to even, and clip.
 * x: (rows, size) float, size a multiple of 8; scales: (rows,) float; out: (rows, size) int16
 */
export function quantize(x: usize, scales: usize, out: usize, rows: i32, size: i32, lowest: f32, highest: f32): void {
  const least = f32x4.splat(lowest), most = f32x4.splat(highest);
  for (let row = 0; row < rows; row++) {
    const scale = v128.load32_splat(scales + FLOAT_BYTES * row);
    for (let i = 0; i < size; i += 8, x += 32, out += 16) {
      v128.store(out, i16x8.narrow_i32x4_s(toIntegers(x, scale, least, most), toIntegers(x + 16, scale, least, most)));
    }
  }
}

/**
 * out = factor * tanh(factor * x) + offset: the sigmoid with 0.5 and 0.5, the hyperbolic tangent with 1 and 0.
 * The rational function is that of Eigen and onnxruntime, within 2e-7.
 * x, out: (count,) float; up to three values may be written past the end of out
 */
export function activate(x: usize, out: usize, count: i32, factor: f32, offset: f32): void {
  const scale = f32x4.splat(factor);
  for (let i = 0; i < count; i += 4, x += 16, out += 16) {
    const v = f32x4.min(f32x4.splat(9), f32x4.max(f32x4.splat(-9), f32x4.mul(scale, v128.load(x))));
    const square = f32x4.mul(v, v);
    let p = f32x4.splat(-2.76076847742355e-16);
    p = addTerm(p, square, 2.00018790482477e-13);
    p = addTerm(p, square, -8.60467152213735e-11);
    p = addTerm(p, square, 5.12229709037114e-08);
    p = addTerm(p, square, 1.48572235717979e-05);
    p = addTerm(p, square, 6.37261928875436e-04);
    p = addTerm(p, square, 4.89352455891786e-03);
    let q = f32x4.splat(1.19825839466702e-06);
    q = addTerm(q, square, 1.18534705686654e-04);
    q = addTerm(q, square, 2.268434632439e-03);
    q = addTerm(q, square, 4.89352518554385e-03);
    v128.store(out, f32x4.add(f32x4.splat(offset), f32x4.mul(scale, f32x4.div(f32x4.mul(v, p), q))));
  }
}

/** Return the sum of the products of two rows of floats, size a multiple of 4. */
function dot(x: usize, weights: usize, size: u32): f32 {
  let sum = f32x4.splat(0);
  for (let end = weights + FLOAT_BYTES * size; weights < end; weights += 16, x += 16) sum = addProduct(sum, v128.load(x), weights);
  return f32x4.extract_lane(sum, 0) + f32x4.extract_lane(sum, 1) + (f32x4.extract_lane(sum, 2) + f32x4.extract_lane(sum, 3));
}

/**
 * Filter a signal at the positions (first + i * down) / up, whose phase is the remainder.
 * x: float, from the sample at position 0 of the filter on; out: (count,) float
 * table: (phases + 1, size) float, size a multiple of 4. Row p is the filter at phase p / phases,
 * so the last row is phase 0 of the next sample. Between rows, the filter is interpolated linearly.
 */
export function resample(x: usize, table: usize, out: usize, count: i32, size: u32, phases: u32, up: u32, down: u32, first: u32): void {
  for (let i = 0; i < count; i++, first += down) {
    const from = x + FLOAT_BYTES * (first / up);
    const phase = (first % up) * phases;
    const row = table + FLOAT_BYTES * (phase / up) * size;
    const rest = phase % up;
    let value = dot(from, row, size);
    if (rest) value += (f32(rest) / f32(up)) * (dot(from, row + FLOAT_BYTES * size, size) - value);
    store<f32>(out + FLOAT_BYTES * i, value);
  }
}
