;; The product of a matrix and a vector of 8-bit integers, 16 at a time.
;;
;; values:  (size,) int8, size a multiple of 16
;; weights: (rows, size) int8
;; sums:    (rows,) int32, written
(module
  (memory (import "env" "memory") 1)
  (func (export "matvec")
    (param $values i32) (param $weights i32) (param $sums i32) (param $size i32) (param $rows i32)
    (local $at i32) (local $end i32) (local $last i32) (local $sum v128)
    (local $value v128) (local $weight v128)
    (local.set $end (i32.add (local.get $values) (local.get $size)))
    (local.set $last (i32.add (local.get $sums) (i32.shl (local.get $rows) (i32.const 2))))
    (loop $row
      (local.set $sum (v128.const i32x4 0 0 0 0))
      (local.set $at (local.get $values))
      (loop $block
        (local.set $value (v128.load (local.get $at)))
        (local.set $weight (v128.load (local.get $weights)))
        (local.set $sum
          (i32x4.add
            (local.get $sum)
            (i32x4.add
              (i32x4.extadd_pairwise_i16x8_s
                (i16x8.extmul_low_i8x16_s (local.get $value) (local.get $weight)))
              (i32x4.extadd_pairwise_i16x8_s
                (i16x8.extmul_high_i8x16_s (local.get $value) (local.get $weight))))))
        (local.set $weights (i32.add (local.get $weights) (i32.const 16)))
        (local.set $at (i32.add (local.get $at) (i32.const 16)))
        (br_if $block (i32.lt_u (local.get $at) (local.get $end))))
      (i32.store
        (local.get $sums)
        (i32.add
          (i32.add (i32x4.extract_lane 0 (local.get $sum)) (i32x4.extract_lane 1 (local.get $sum)))
          (i32.add (i32x4.extract_lane 2 (local.get $sum)) (i32x4.extract_lane 3 (local.get $sum)))))
      (local.set $sums (i32.add (local.get $sums) (i32.const 4)))
      (br_if $row (i32.lt_u (local.get $sums) (local.get $last))))))
